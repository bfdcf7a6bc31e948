import type { PairPlayback } from "@/shared/media/usePairPlayer";
import { Key } from "@/shared/ui/Key";
import { letGo } from "./AnswerBar";
import { type Command, SPEEDS } from "./answers";

interface TransportProps {
  player: PairPlayback;
  canUndo: boolean;
  onCommand: (command: Command) => void;
}

/** Undo, pause, single frames and speed. */
export function Transport({ player, canUndo, onCommand }: TransportProps) {
  const idle = player.state !== "playing";
  return (
    <div className="transport" role="toolbar" aria-label="Playback">
      <Control keys={["Z"]} words="Undo" disabled={!canUndo} onPress={() => onCommand({ do: "undo" })} />
      <Control
        keys={["Space"]}
        words={player.paused ? "Play" : "Pause"}
        disabled={idle}
        onPress={() => onCommand({ do: "pause" })}
      />
      <Control
        keys={[","]}
        words="Frame back"
        disabled={idle}
        onPress={() => onCommand({ do: "step", direction: -1 })}
      />
      <Control
        keys={["."]}
        words="Frame on"
        disabled={idle}
        onPress={() => onCommand({ do: "step", direction: 1 })}
      />
      <fieldset className="speeds" aria-label="Speed">
        {SPEEDS.map(({ key, speed, words }) => (
          <Control
            key={key}
            keys={[key]}
            words={words}
            disabled={false}
            pressed={player.speed === speed}
            onPress={() => onCommand({ do: "speed", speed })}
          />
        ))}
      </fieldset>
    </div>
  );
}

interface ControlProps {
  keys: string[];
  words: string;
  disabled: boolean;
  pressed?: boolean;
  onPress: () => void;
}

function Control({ keys, words, disabled, pressed, onPress }: ControlProps) {
  return (
    <button
      type="button"
      className="button small control"
      aria-disabled={disabled}
      aria-pressed={pressed}
      onClick={(event) => {
        letGo(event);
        if (!disabled) onPress();
      }}
    >
      {keys.map((name) => (
        <Key key={name} name={name} />
      ))}
      {words}
    </button>
  );
}
