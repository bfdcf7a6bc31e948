import type { ReactNode } from "react";

/** A page that has only something to say. */
export function Message({ title, children }: { title: string; children: ReactNode }) {
  return (
    <main className="message" id="content">
      <h1>{title}</h1>
      {children}
    </main>
  );
}

/** What went wrong, beside the thing that it went wrong with. */
export function Trouble({ children }: { children: ReactNode }) {
  return (
    <p className="trouble" role="alert">
      {children}
    </p>
  );
}
