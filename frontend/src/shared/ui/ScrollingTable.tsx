import type { ReactNode } from "react";

interface ScrollingTableProps {
  /** what the table holds, for screen readers */
  label: string;
  children: ReactNode;
}

/** A table that scrolls sideways where it is wider than its place. */
export function ScrollingTable({ label, children }: ScrollingTableProps) {
  return (
    // biome-ignore lint/a11y/noNoninteractiveTabindex: a region that scrolls must be reachable by keyboard
    <section className="table-scroll" aria-label={label} tabIndex={0}>
      {children}
    </section>
  );
}
