import type { RefObject } from "react";
import type { Query } from "@/shared/api/types";
import type { PairPlayback } from "@/shared/media/usePairPlayer";
import type { Answer } from "./answers";

interface PairStageProps {
  query: Query;
  /** pairs that follow this one, whose clips are loaded meanwhile */
  ahead: number;
  flash: Answer | null;
  player: PairPlayback;
  left: RefObject<HTMLCanvasElement | null>;
  right: RefObject<HTMLCanvasElement | null>;
  position: RefObject<HTMLDivElement | null>;
}

/** The two clips, side by side, as large as the window allows. */
export function PairStage({ query, ahead, flash, player, left, right, position }: PairStageProps) {
  return (
    <section
      className="stage"
      aria-label={`Pair ${query.number}`}
      data-stage=""
      data-testid="stage"
      data-query={query.id}
      data-left={query.left.segment_id}
      data-right={query.right.segment_id}
      data-state={player.state}
      data-ahead={ahead}
      style={{ "--ratio": player.ratio } as React.CSSProperties}
    >
      <Side name="Left" canvas={left} mark={markOf("left", flash)} state={player.state} />
      <Side name="Right" canvas={right} mark={markOf("right", flash)} state={player.state} />
      <div className="position" ref={position} aria-hidden="true">
        <div />
      </div>
      {query.left.clip_url === null && (
        <p className="stage-note">This experiment makes no clips: only scripted teachers can label it.</p>
      )}
      {player.state === "failed" && (
        <p className="stage-note" role="alert">
          This pair cannot be played. {player.trouble}
          <span className="row">
            <button type="button" className="button" onClick={player.retry}>
              Try again
            </button>
            or skip it with the down arrow
          </span>
        </p>
      )}
    </section>
  );
}

type Mark = "better" | "equal" | "skipped" | "worse" | null;

function markOf(side: "left" | "right", flash: Answer | null): Mark {
  if (flash === null) return null;
  if (flash === "equal") return "equal";
  if (flash === "skip") return "skipped";
  return flash === side ? "better" : "worse";
}

const MARK_WORDS = { better: "✓ Better", equal: "= Equal", skipped: "Skipped", worse: "" } as const;

interface SideProps {
  name: "Left" | "Right";
  canvas: RefObject<HTMLCanvasElement | null>;
  mark: Mark;
  state: PairPlayback["state"];
}

function Side({ name, canvas, mark, state }: SideProps) {
  return (
    <div className="side">
      <figure className="clip" data-mark={mark ?? undefined}>
        <canvas
          ref={canvas}
          data-testid={`clip-${name.toLowerCase()}`}
          role="img"
          aria-label={`${name} clip`}
        />
        <figcaption>{name}</figcaption>
        {mark && MARK_WORDS[mark] && <span className="mark">{MARK_WORDS[mark]}</span>}
        {state === "loading" && <span className="loading">Loading the clip…</span>}
      </figure>
    </div>
  );
}
