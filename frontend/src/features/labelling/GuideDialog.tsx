import { type ReactNode, useEffect, useId, useRef } from "react";

interface GuideDialogProps {
  title: string;
  children: ReactNode;
  /** buttons beside "Close" */
  actions?: ReactNode;
  onClose: () => void;
}

/** A dialog that only shows something: the rules or the keys. Escape and "Close" close it. */
export function GuideDialog({ title, children, actions, onClose }: GuideDialogProps) {
  const dialog = useRef<HTMLDialogElement>(null);
  const id = useId();
  useEffect(() => dialog.current?.showModal(), []);
  return (
    <dialog ref={dialog} className="dialog guide" aria-labelledby={id} onClose={onClose}>
      <h2 id={id}>{title}</h2>
      {/* biome-ignore lint/a11y/noNoninteractiveTabindex: a region that scrolls must be reachable with the keyboard */}
      <section className="guide-body" aria-labelledby={id} tabIndex={0}>
        {children}
      </section>
      <div className="row end">
        {actions}
        <button type="button" className="button primary" onClick={() => dialog.current?.close()}>
          Close
        </button>
      </div>
    </dialog>
  );
}
