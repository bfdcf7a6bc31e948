import { useEffect, useRef, useState } from "react";

/** The instructions of the experiment. Where they are cut off, a button shows all of them. */
export function Instructions({ text }: { text: string }) {
  const heading = useRef<HTMLHeadingElement>(null);
  const dialog = useRef<HTMLDialogElement>(null);
  const [isCut, setIsCut] = useState(false);
  useEffect(() => {
    const element = heading.current;
    if (!element) return;
    const observer = new ResizeObserver(() => setIsCut(element.scrollHeight > element.clientHeight + 1));
    observer.observe(element);
    return () => observer.disconnect();
  }, []);
  return (
    <div className="instructions">
      <h1 ref={heading}>{text}</h1>
      {isCut && (
        <button type="button" className="button small" onClick={() => dialog.current?.showModal()}>
          Read all
        </button>
      )}
      <dialog ref={dialog} className="dialog" aria-labelledby="instructions-title">
        <h2 id="instructions-title">What to look for</h2>
        <p className="instructions-text">{text}</p>
        <div className="row end">
          <button type="button" className="button primary" onClick={() => dialog.current?.close()}>
            Close
          </button>
        </div>
      </dialog>
    </div>
  );
}
