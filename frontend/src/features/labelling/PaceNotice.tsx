import { useState } from "react";
import type { Choice } from "./choices";
import { Pace } from "./pace";
import "./pace.css";

/** Whether the last answers were all the same and very quick. `add` is called with every answer. */
export function usePace() {
  const [pace] = useState(() => new Pace());
  const [isHasty, setHasty] = useState(false);
  const [actions] = useState(() => ({
    add(choice: Choice, seconds: number) {
      if (choice !== "skip") pace.add(choice, seconds);
      setHasty(pace.isHasty);
    },
    dismiss() {
      pace.reset();
      setHasty(false);
    },
  }));
  return { isHasty, ...actions };
}

/** One kind sentence after a run of equal, very quick answers. It blocks nothing. */
export function PaceNotice({ visible, onDismiss }: { visible: boolean; onDismiss: () => void }) {
  return (
    <div className="pace-notice" role="status" aria-live="polite" data-testid="pace-notice">
      {visible && (
        <div className="card">
          <p>
            Your last answers were all the same and very quick. If the clips really look alike, that is fine;
            otherwise take the time you need.
          </p>
          <button type="button" className="button small" onClick={onDismiss}>
            Got it
          </button>
        </div>
      )}
    </div>
  );
}
