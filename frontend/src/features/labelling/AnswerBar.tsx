import type { MouseEvent } from "react";
import { Key } from "@/shared/ui/Key";
import type { Answer } from "./answers";

interface AnswerBarProps {
  enabled: boolean;
  /** a pair that cannot be played can still be skipped */
  skippable: boolean;
  flash: Answer | null;
  onAnswer: (answer: Answer) => void;
}

const BUTTONS = [
  { answer: "left", key: "←", words: "Left is better", hint: "Left arrow" },
  { answer: "equal", key: "↑", words: "Equally good", hint: "Up arrow" },
  { answer: "skip", key: "↓", words: "Can’t tell, skip", hint: "Down arrow" },
  { answer: "right", key: "→", words: "Right is better", hint: "Right arrow" },
] as const;

/**
 * The four answers, each with its key.
 *
 * While there is nothing to answer they are `aria-disabled`, not `disabled`: a button that has the focus must not lose
 * it from one pair to the next.
 */
export function AnswerBar({ enabled, skippable, flash, onAnswer }: AnswerBarProps) {
  return (
    <fieldset className="answers" aria-label="Your answer">
      {BUTTONS.map(({ answer, key, words, hint }) => (
        <button
          key={answer}
          type="button"
          className={`button answer answer-${answer}`}
          data-chosen={flash === answer || undefined}
          aria-disabled={!(answer === "skip" ? skippable : enabled)}
          aria-keyshortcuts={`Arrow${hint.split(" ")[0]}`}
          title={`${words} (${hint})`}
          onClick={(event) => {
            letGo(event);
            if (answer === "skip" ? skippable : enabled) onAnswer(answer);
          }}
        >
          <Key name={key} />
          <span>{words}</span>
        </button>
      ))}
    </fieldset>
  );
}

/** After a click with the mouse the button gives up the focus, lest the next Space press it instead of pausing. */
export function letGo(event: MouseEvent<HTMLButtonElement>): void {
  if (event.detail > 0) event.currentTarget.blur();
}
