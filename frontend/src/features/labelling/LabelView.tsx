import { useCallback, useEffect, useRef, useState } from "react";
import type { Experiment, Query, SegmentView } from "@/shared/api/types";
import type { ClipSource } from "@/shared/media/clip";
import { ClipCache } from "@/shared/media/clipCache";
import { usePairPlayer } from "@/shared/media/usePairPlayer";
import { isOver } from "@/shared/ui/status";
import { ChoiceButtons } from "./ChoiceButtons";
import { ClipPair } from "./ClipPair";
import type { Choice } from "./choices";
import { type Command, useKeyboardCommands } from "./commands";
import { ExperimentSummary } from "./ExperimentSummary";
import { HistoryPanel } from "./HistoryPanel";
import { Instructions } from "./Instructions";
import { useClipNames } from "./layout";
import { NoPair } from "./NoPair";
import { PlaybackControls } from "./PlaybackControls";
import { usePairNotification } from "./pairNotification";
import { ReviewBanner } from "./ReviewBanner";
import { StatusLine } from "./StatusLine";
import { useLabellingSession } from "./useLabellingSession";

/** Nobody compares two clips faster than this: an earlier key press was meant for the previous pair. */
const MIN_RESPONSE_SECONDS = 0.3;

interface LabelViewProps {
  experiment: Experiment;
  connected: boolean;
}

/** The instructions, the pair of clips, the choices, and the progress of the experiment. */
export function LabelView({ experiment, connected }: LabelViewProps) {
  const { session, view } = useLabellingSession(experiment.id);
  const names = useClipNames();
  const [historyOpen, setHistoryOpen] = useState(false);
  const [clips] = useState(() => new ClipCache());
  const left = useRef<HTMLCanvasElement>(null);
  const right = useRef<HTMLCanvasElement>(null);
  const progress = useRef<HTMLDivElement>(null);
  const { upcoming, reviewed } = view;
  const last = view.history.at(-1);
  const over = isOver(experiment);
  const current = over ? (reviewed?.query ?? null) : view.current;
  const player = usePairPlayer(
    clips,
    current && clipSource(current.left),
    current && clipSource(current.right),
    view.displayCount,
    { left, right, progress },
  );

  useEffect(() => {
    clips.prefetch(clipSources([current, ...upcoming, last?.query]));
  }, [clips, current, upcoming, last]);
  useEffect(() => () => clips.clear(), [clips]);

  // biome-ignore lint/correctness/useExhaustiveDependencies: after these changes there may be new pairs
  useEffect(() => {
    if (!session?.view().current) session?.refresh();
  }, [session, experiment.status, experiment.phase, experiment.labels.open_queries, connected]);

  const choose = useCallback(
    (choice: Choice) => {
      const watched = player.watchedSeconds();
      if (watched !== null && watched >= MIN_RESPONSE_SECONDS) session?.choose(choice, watched);
      else if (player.state === "failed" && choice === "skip") session?.choose(choice, 0);
    },
    [session, player],
  );
  const run = useCallback(
    (command: Command) => {
      if (command.type === "choose" && !over) choose(command.choice);
      else if (command.type === "undo") session?.undo();
      else if (command.type === "closeReview") session?.closeReview();
      else if (command.type === "toggleHistory") setHistoryOpen((open) => !open);
      else if (command.type === "togglePause") player.togglePause();
      else if (command.type === "step") player.step(command.direction);
      else if (command.type === "setSpeed") player.setSpeed(command.speed);
    },
    [choose, session, player, over],
  );
  useKeyboardCommands(run);
  usePairNotification(experiment.name, current !== null);

  const onChoose = (choice: Choice) => run({ type: "choose", choice });
  const closeReview = () => run({ type: "closeReview" });
  const review = (id: string) => {
    session?.review(id);
    window.scrollTo(0, 0);
  };

  return (
    <main className="label-page" id="content" data-history={historyOpen || undefined}>
      <div className="label-view">
        {reviewed ? (
          <ReviewBanner pair={reviewed} names={names} onClose={closeReview} />
        ) : (
          <Instructions text={experiment.instructions} />
        )}
        {current ? (
          <ClipPair
            query={current}
            upcoming={upcoming.length}
            chosen={view.chosen}
            player={player}
            left={left}
            right={right}
            progress={progress}
            names={names}
            onChoose={onChoose}
          />
        ) : (
          <NoPair
            experiment={experiment}
            reason={over ? "experiment_over" : view.reason}
            error={view.error}
            aspectRatio={player.aspectRatio}
          />
        )}
        <div className="answer-bar">
          <StatusLine
            view={view}
            experiment={experiment}
            names={names}
            onUndo={() => run({ type: "undo" })}
          />
          <ChoiceButtons
            enabled={current !== null && player.state === "playing" && !over}
            canSkip={current !== null && player.state !== "loading" && !over}
            chosen={view.chosen}
            names={names}
            onChoose={onChoose}
          />
        </div>
        <PlaybackControls
          player={player}
          canUndo={last !== undefined || view.chosen !== null}
          historyOpen={historyOpen}
          onCommand={run}
        />
        <ExperimentSummary experiment={experiment} view={view} connected={connected} />
      </div>
      {historyOpen && (
        <HistoryPanel
          view={view}
          names={names}
          onReview={review}
          onLoadOlder={() => session?.loadOlder()}
          onClose={() => setHistoryOpen(false)}
        />
      )}
    </main>
  );
}

/** The clip of a segment; null in an experiment without clips. */
function clipSource({ clip_url, frames, seconds }: SegmentView): ClipSource | null {
  return clip_url === null ? null : { url: clip_url, frames, seconds };
}

function clipSources(queries: readonly (Query | null | undefined)[]): ClipSource[] {
  return queries
    .flatMap((query) => (query ? [clipSource(query.left), clipSource(query.right)] : []))
    .filter((source) => source !== null);
}
