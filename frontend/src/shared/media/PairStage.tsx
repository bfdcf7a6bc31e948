import { type ReactNode, useEffect, useRef, useState } from "react";
import { Key } from "@/shared/ui/Key";
import type { ClipSource } from "./clip";
import { ClipCache } from "./clipCache";
import { type PairPlayback, usePairPlayer } from "./usePairPlayer";
import "./pair-stage.css";

export interface StageSide {
  name: string;
  clip: ClipSource | null;
  /** shown over the clip, for example why there is none */
  note?: string | undefined;
}

interface PairStageProps {
  label: string;
  left: StageSide;
  right: StageSide;
  /** what to show under each clip */
  below: (side: "left" | "right", player: PairPlayback) => ReactNode;
}

const SPEEDS = [0.25, 0.5, 1, 2] as const;
const SIDES = ["left", "right"] as const;

/** Two clips on one clock with their controls, to look at; the labelling page has a view of its own. */
export function PairStage({ label, left, right, below }: PairStageProps) {
  const [clips] = useState(() => new ClipCache());
  const canvases = { left: useRef<HTMLCanvasElement>(null), right: useRef<HTMLCanvasElement>(null) };
  const progress = useRef<HTMLDivElement>(null);
  const player = usePairPlayer(clips, left.clip, right.clip, 0, { ...canvases, progress });
  // Decoded clips are large, so those that are no longer shown are freed.
  // biome-ignore lint/correctness/useExhaustiveDependencies: a clip is identified by its URL
  useEffect(
    () => clips.prefetch([left.clip, right.clip].filter((clip) => clip !== null)),
    [clips, left.clip?.url, right.clip?.url],
  );
  useEffect(() => () => clips.clear(), [clips]);
  usePlaybackKeys(player);
  const sides = { left, right };
  return (
    <section
      className="stage"
      aria-label={label}
      data-pair=""
      data-testid="pair"
      data-state={player.state}
      style={{ "--aspect-ratio": player.aspectRatio } as React.CSSProperties}
    >
      {SIDES.map((side) => (
        <div key={side} className="stage-side">
          <figure>
            <canvas
              ref={canvases[side]}
              data-testid={`clip-${side}`}
              role="img"
              aria-label={`${sides[side].name} clip`}
            />
            <figcaption>{sides[side].name}</figcaption>
            <p className="stage-note" role="status">
              {sides[side].note}
            </p>
          </figure>
          {below(side, player)}
        </div>
      ))}
      <div className="stage-progress" ref={progress} aria-hidden="true">
        <div />
      </div>
      {player.state === "failed" && (
        <p className="alert" role="alert">
          These clips cannot be played. {player.error}{" "}
          <button type="button" className="button small" onClick={player.retry}>
            Try again
          </button>
        </p>
      )}
      <PlaybackBar player={player} />
    </section>
  );
}

function PlaybackBar({ player }: { player: PairPlayback }) {
  const disabled = player.state !== "playing";
  return (
    <div className="stage-bar row" role="toolbar" aria-label="Playback">
      <button type="button" className="button small" disabled={disabled} onClick={player.togglePause}>
        <Key name="Space" /> {player.paused ? "Play" : "Pause"}
      </button>
      <button type="button" className="button small" disabled={disabled} onClick={() => player.step(-1)}>
        <Key name="," /> Previous frame
      </button>
      <button type="button" className="button small" disabled={disabled} onClick={() => player.step(1)}>
        <Key name="." /> Next frame
      </button>
      <label className="row">
        Speed
        <select value={player.speed} onChange={(event) => player.setSpeed(Number(event.target.value))}>
          {SPEEDS.map((speed) => (
            <option key={speed} value={speed}>
              {speed}×
            </option>
          ))}
        </select>
      </label>
    </div>
  );
}

/** Space pauses; comma and full stop step by one frame. */
function usePlaybackKeys({ togglePause, step }: PairPlayback): void {
  useEffect(() => {
    const listen = (event: KeyboardEvent) => {
      const target = event.target instanceof Element ? event.target : null;
      if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
      if (target?.closest("input, textarea, select") || document.querySelector("dialog[open]")) return;
      if (event.key === " " && !target?.closest("button, a, summary")) togglePause();
      else if (event.key === ",") step(-1);
      else if (event.key === ".") step(1);
      else return;
      event.preventDefault();
    };
    window.addEventListener("keydown", listen);
    return () => window.removeEventListener("keydown", listen);
  }, [togglePause, step]);
}
