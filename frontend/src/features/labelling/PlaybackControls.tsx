import type { PairPlayback } from "@/shared/media/usePairPlayer";
import { Key } from "@/shared/ui/Key";
import { blurAfterMouseClick } from "./ChoiceButtons";
import { type Command, SPEEDS } from "./commands";

interface PlaybackControlsProps {
  player: PairPlayback;
  canUndo: boolean;
  historyOpen: boolean;
  onCommand: (command: Command) => void;
}

/** Buttons for undo, the history, pause, single frames and speed. */
export function PlaybackControls({ player, canUndo, historyOpen, onCommand }: PlaybackControlsProps) {
  const disabled = player.state !== "playing";
  return (
    <div className="playback" role="toolbar" aria-label="Playback">
      <Control keyName="Z" text="Undo" disabled={!canUndo} onClick={() => onCommand({ type: "undo" })} />
      <Control
        keyName="H"
        text="Your labels"
        disabled={false}
        pressed={historyOpen}
        onClick={() => onCommand({ type: "toggleHistory" })}
      />
      <Control
        keyName="Space"
        text={player.paused ? "Play" : "Pause"}
        disabled={disabled}
        onClick={() => onCommand({ type: "togglePause" })}
      />
      <Control
        keyName=","
        text="Previous frame"
        disabled={disabled}
        onClick={() => onCommand({ type: "step", direction: -1 })}
      />
      <Control
        keyName="."
        text="Next frame"
        disabled={disabled}
        onClick={() => onCommand({ type: "step", direction: 1 })}
      />
      <fieldset className="speeds" aria-label="Playback speed">
        {SPEEDS.map(({ key, speed, text }) => (
          <Control
            key={key}
            keyName={key}
            text={text}
            disabled={false}
            pressed={player.speed === speed}
            onClick={() => onCommand({ type: "setSpeed", speed })}
          />
        ))}
      </fieldset>
    </div>
  );
}

interface ControlProps {
  keyName: string;
  text: string;
  disabled: boolean;
  pressed?: boolean;
  onClick: () => void;
}

function Control({ keyName, text, disabled, pressed, onClick }: ControlProps) {
  return (
    <button
      type="button"
      className="button small playback-button"
      aria-disabled={disabled}
      aria-pressed={pressed}
      onClick={(event) => {
        blurAfterMouseClick(event);
        if (!disabled) onClick();
      }}
    >
      <Key name={keyName} />
      {text}
    </button>
  );
}
