import type { RefObject } from "react";
import type { Query } from "@/shared/api/types";
import type { PairPlayback } from "@/shared/media/usePairPlayer";
import type { Choice } from "./choices";
import type { ClipNames } from "./layout";

interface ClipPairProps {
  query: Query;
  /** number of pairs that follow; their clips are being loaded */
  upcoming: number;
  /** the choice just made, marked on the clips until the next pair is shown */
  chosen: Choice | null;
  player: PairPlayback;
  left: RefObject<HTMLCanvasElement | null>;
  right: RefObject<HTMLCanvasElement | null>;
  progress: RefObject<HTMLDivElement | null>;
  names: ClipNames;
  onChoose: (choice: Choice) => void;
}

/** Two clips side by side, or one above the other on an upright phone, as large as the window allows. */
export function ClipPair(props: ClipPairProps) {
  const { query, upcoming, chosen, player, left, right, progress, names, onChoose } = props;
  return (
    <section
      className="pair"
      aria-label={`Pair ${query.number}`}
      data-pair=""
      data-testid="pair"
      data-query={query.id}
      data-left={query.left.segment_id}
      data-right={query.right.segment_id}
      data-state={player.state}
      data-upcoming={upcoming}
      style={{ "--aspect-ratio": player.aspectRatio } as React.CSSProperties}
    >
      <ClipView
        side="left"
        name={names.left}
        canvas={left}
        verdict={verdictOf("left", chosen)}
        state={player.state}
        onChoose={onChoose}
      />
      <ClipView
        side="right"
        name={names.right}
        canvas={right}
        verdict={verdictOf("right", chosen)}
        state={player.state}
        onChoose={onChoose}
      />
      <div className="playback-progress" ref={progress} aria-hidden="true">
        <div />
      </div>
      {query.left.clip_url === null && (
        <p className="pair-note">This experiment has no clips: only scripted teachers can label it.</p>
      )}
      {player.state === "failed" && (
        <p className="pair-note" role="alert">
          This pair cannot be played. {player.error}
          <span className="row">
            <button type="button" className="button" onClick={player.retry}>
              Try again
            </button>
            or skip it
          </span>
        </p>
      )}
    </section>
  );
}

type Verdict = "better" | "equal" | "skipped" | "worse" | null;

function verdictOf(side: "left" | "right", chosen: Choice | null): Verdict {
  if (chosen === null) return null;
  if (chosen === "equal") return "equal";
  if (chosen === "skip") return "skipped";
  return chosen === side ? "better" : "worse";
}

const VERDICT_TEXT = { better: "✓ Better", equal: "= Equal", skipped: "Skipped", worse: "" } as const;

interface ClipViewProps {
  side: "left" | "right";
  name: string;
  canvas: RefObject<HTMLCanvasElement | null>;
  verdict: Verdict;
  state: PairPlayback["state"];
  onChoose: (choice: Choice) => void;
}

function ClipView({ side, name, canvas, verdict, state, onChoose }: ClipViewProps) {
  return (
    <div className="pair-side">
      <figure className="clip" data-verdict={verdict ?? undefined}>
        <canvas ref={canvas} data-testid={`clip-${side}`} role="img" aria-label={`${name} clip`} />
        {/* On touch screens only: with a mouse, a click that returns to the window would label the pair. The answer
            buttons do the same for assistive technology and the keyboard. */}
        <button
          type="button"
          className="tap"
          tabIndex={-1}
          aria-hidden="true"
          onClick={() => onChoose(side)}
        />
        <figcaption>{name}</figcaption>
        {verdict && VERDICT_TEXT[verdict] && <span className="verdict">{VERDICT_TEXT[verdict]}</span>}
        {state === "loading" && <span className="loading">Loading…</span>}
      </figure>
    </div>
  );
}
