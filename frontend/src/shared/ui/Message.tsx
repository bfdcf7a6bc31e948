import type { ReactNode } from "react";

/** A page that shows only a message. */
export function Message({ title, children }: { title: string; children: ReactNode }) {
  return (
    <main className="message" id="content">
      <h1>{title}</h1>
      {children}
    </main>
  );
}

/** An error message, placed next to what failed. */
export function Alert({ children }: { children: ReactNode }) {
  return (
    <p className="alert" role="alert">
      {children}
    </p>
  );
}
