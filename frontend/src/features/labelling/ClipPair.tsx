import type { RefObject } from "react";
import type { Query } from "@/shared/api/types";
import type { PairPlayback } from "@/shared/media/usePairPlayer";
import type { Choice } from "./choices";

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
}

/** Two clips side by side, as large as the window allows. */
export function ClipPair({ query, upcoming, chosen, player, left, right, progress }: ClipPairProps) {
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
      <ClipView name="Left" canvas={left} verdict={verdictOf("left", chosen)} state={player.state} />
      <ClipView name="Right" canvas={right} verdict={verdictOf("right", chosen)} state={player.state} />
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
            or press the down arrow to skip it
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
  name: "Left" | "Right";
  canvas: RefObject<HTMLCanvasElement | null>;
  verdict: Verdict;
  state: PairPlayback["state"];
}

function ClipView({ name, canvas, verdict, state }: ClipViewProps) {
  return (
    <div className="pair-side">
      <figure className="clip" data-verdict={verdict ?? undefined}>
        <canvas
          ref={canvas}
          data-testid={`clip-${name.toLowerCase()}`}
          role="img"
          aria-label={`${name} clip`}
        />
        <figcaption>{name}</figcaption>
        {verdict && VERDICT_TEXT[verdict] && <span className="verdict">{VERDICT_TEXT[verdict]}</span>}
        {state === "loading" && <span className="loading">Loading…</span>}
      </figure>
    </div>
  );
}
