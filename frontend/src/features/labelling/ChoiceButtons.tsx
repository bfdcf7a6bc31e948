import type { MouseEvent } from "react";
import { Key } from "@/shared/ui/Key";
import type { Choice } from "./choices";
import type { ClipNames } from "./layout";

interface ChoiceButtonsProps {
  enabled: boolean;
  /** whether Skip is enabled: a pair that cannot be played can still be skipped */
  canSkip: boolean;
  /** the choice just made, highlighted until the next pair is shown */
  chosen: Choice | null;
  /** whether one can also choose slightly better */
  slight: boolean;
  names: ClipNames;
  onChoose: (choice: Choice) => void;
}

/** With the answer scale `five`, in two rows of three on phones. */
const BUTTONS = [
  { choice: "left", key: "←", keyName: "ArrowLeft", hint: "Left arrow" },
  { choice: "slightlyLeft", key: "⇧ ←", keyName: "Shift+ArrowLeft", hint: "Shift and left arrow" },
  { choice: "equal", key: "↑", keyName: "ArrowUp", hint: "Up arrow" },
  { choice: "skip", key: "↓", keyName: "ArrowDown", hint: "Down arrow" },
  { choice: "slightlyRight", key: "⇧ →", keyName: "Shift+ArrowRight", hint: "Shift and right arrow" },
  { choice: "right", key: "→", keyName: "ArrowRight", hint: "Right arrow" },
] as const;

/** The text of a button, and a shorter one for small screens. */
function textOf(choice: Choice, names: ClipNames): { text: string; short: string } {
  if (choice === "equal") return { text: "Equally good", short: "Equal" };
  if (choice === "skip") return { text: "Can’t tell, skip", short: "Skip" };
  if (choice === "slightlyLeft") return { text: `${names.left} slightly`, short: `${names.left} slightly` };
  if (choice === "slightlyRight")
    return { text: `${names.right} slightly`, short: `${names.right} slightly` };
  return { text: `${names[choice]} is better`, short: names[choice] };
}

/**
 * One button per choice, with its key.
 *
 * Without a pair the buttons are `aria-disabled`, not `disabled`, so that a focused button keeps the focus from one
 * pair to the next.
 */
export function ChoiceButtons({ enabled, canSkip, chosen, slight, names, onChoose }: ChoiceButtonsProps) {
  const buttons = BUTTONS.filter(({ choice }) => slight || !choice.startsWith("slightly"));
  return (
    <fieldset className="choices" data-scale={slight ? "five" : "three"} aria-label="Which clip is better?">
      {buttons.map(({ choice, key, keyName, hint }) => {
        const active = choice === "skip" ? canSkip : enabled;
        const { text, short } = textOf(choice, names);
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
            <span className="choice-text">{text}</span>
            <span className="choice-short">{short}</span>
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
