import { LazyMarkdown } from "@/shared/markdown/LazyMarkdown";
import { summaryOf } from "@/shared/markdown/summary";
import { GuideDialog } from "./GuideDialog";

/** The beginning of the instructions above the clips, with the button that shows all of them. */
export function Instructions({ text, onOpen }: { text: string; onOpen: () => void }) {
  return (
    <div className="instructions">
      <h1>{summaryOf(text)}</h1>
      <RulesButton onOpen={onOpen} />
    </div>
  );
}

export function RulesButton({ onOpen }: { onOpen: () => void }) {
  return (
    <button type="button" className="button small" aria-keyshortcuts="r" onClick={onOpen}>
      Rules
    </button>
  );
}

/** All instructions, over the pair, which stays as it is. */
export function RulesDialog({ text, onClose }: { text: string; onClose: () => void }) {
  return (
    <GuideDialog title="What to look for" onClose={onClose}>
      <LazyMarkdown text={text} />
    </GuideDialog>
  );
}
