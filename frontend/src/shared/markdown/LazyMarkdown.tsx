import { lazy, Suspense } from "react";

const Markdown = lazy(() => import("./Markdown").then((module) => ({ default: module.Markdown })));

/** `Markdown`, loaded when it is first shown; until then the text as it was written. */
export function LazyMarkdown({ text }: { text: string }) {
  return (
    <Suspense fallback={<p className="instructions-text">{text}</p>}>
      <Markdown text={text} />
    </Suspense>
  );
}
