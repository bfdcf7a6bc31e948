import type { MouseEvent } from "react";
import { Key } from "@/shared/ui/Key";
import type { Choice } from "./choices";

interface ChoiceButtonsProps {
  enabled: boolean;
  /** whether Skip is enabled: a pair that cannot be played can still be skipped */
  canSkip: boolean;
  /** the choice just made, highlighted until the next pair is shown */
  chosen: Choice | null;
  onChoose: (choice: Choice) => void;
}

const BUTTONS = [
  { choice: "left", key: "←", text: "Left is better", keyName: "ArrowLeft", hint: "Left arrow" },
  { choice: "equal", key: "↑", text: "Equally good", keyName: "ArrowUp", hint: "Up arrow" },
  { choice: "skip", key: "↓", text: "Can’t tell, skip", keyName: "ArrowDown", hint: "Down arrow" },
  { choice: "right", key: "→", text: "Right is better", keyName: "ArrowRight", hint: "Right arrow" },
] as const;

/**
 * One button per choice, with its key.
 *
 * Without a pair the buttons are `aria-disabled`, not `disabled`, so that a focused button keeps the focus from one
 * pair to the next.
 */
export function ChoiceButtons({ enabled, canSkip, chosen, onChoose }: ChoiceButtonsProps) {
  return (
    <fieldset className="choices" aria-label="Which clip is better?">
      {BUTTONS.map(({ choice, key, text, keyName, hint }) => {
        const active = choice === "skip" ? canSkip : enabled;
        return (
          <button
            key={choice}
            type="button"
            className={`button choice choice-${choice}`}
            data-chosen={chosen === choice || undefined}
            aria-disabled={!active}
            aria-keyshortcuts={keyName}
            title={`${text} (${hint})`}
            onClick={(event) => {
              blurAfterMouseClick(event);
              if (active) onChoose(choice);
            }}
          >
            <Key name={key} />
            <span>{text}</span>
          </button>
        );
      })}
    </fieldset>
  );
}

/** Removes the focus from a button clicked with the mouse, so that Space pauses instead of clicking it again. */
export function blurAfterMouseClick(event: MouseEvent<HTMLButtonElement>): void {
  if (event.detail > 0) event.currentTarget.blur();
}
