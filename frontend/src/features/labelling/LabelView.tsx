import { useCallback, useEffect, useRef, useState } from "react";
import type { Experiment, Me, Query, SegmentView } from "@/shared/api/types";
import type { ClipSource } from "@/shared/media/clip";
import { ClipCache } from "@/shared/media/clipCache";
import { usePairPlayer } from "@/shared/media/usePairPlayer";
import { isOver } from "@/shared/ui/status";
import { ChoiceButtons } from "./ChoiceButtons";
import { ClipPair } from "./ClipPair";
import type { Choice } from "./choices";
import { type Command, useKeyboardCommands } from "./commands";
import { ExperimentSummary } from "./ExperimentSummary";
import { NoPair } from "./NoPair";
import { PlaybackControls } from "./PlaybackControls";
import { usePairNotification } from "./pairNotification";
import { StatusLine } from "./StatusLine";
import { useLabellingSession } from "./useLabellingSession";

/** Nobody compares two clips faster than this: an earlier key press was meant for the previous pair. */
const MIN_RESPONSE_SECONDS = 0.3;

interface LabelViewProps {
  experiment: Experiment;
  me: Me;
  connected: boolean;
}

/** The instructions, the pair of clips, the choices, and the progress of the experiment. */
export function LabelView({ experiment, me, connected }: LabelViewProps) {
  const { session, view } = useLabellingSession(experiment.id, me.id);
  const [clips] = useState(() => new ClipCache());
  const left = useRef<HTMLCanvasElement>(null);
  const right = useRef<HTMLCanvasElement>(null);
  const progress = useRef<HTMLDivElement>(null);
  const { upcoming, last } = view;
  const over = isOver(experiment);
  const current = over ? null : view.current;
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
      if (command.type === "choose") choose(command.choice);
      else if (command.type === "undo") session?.undo();
      else if (command.type === "togglePause") player.togglePause();
      else if (command.type === "step") player.step(command.direction);
      else player.setSpeed(command.speed);
    },
    [choose, session, player],
  );
  useKeyboardCommands(run);
  usePairNotification(experiment.name, current !== null);

  return (
    <main className="label-view" id="content">
      <h1 className="instructions" title={experiment.instructions}>
        {experiment.instructions}
      </h1>
      {current ? (
        <ClipPair
          query={current}
          upcoming={upcoming.length}
          chosen={view.chosen}
          player={player}
          left={left}
          right={right}
          progress={progress}
        />
      ) : (
        <NoPair
          experiment={experiment}
          reason={over ? "experiment_over" : view.reason}
          error={view.error}
          aspectRatio={player.aspectRatio}
        />
      )}
      <ChoiceButtons
        enabled={current !== null && player.state === "playing"}
        canSkip={current !== null && player.state !== "loading"}
        chosen={view.chosen}
        onChoose={(choice) => run({ type: "choose", choice })}
      />
      <PlaybackControls player={player} canUndo={last !== null || view.chosen !== null} onCommand={run} />
      <StatusLine view={view} experiment={experiment} />
      <ExperimentSummary experiment={experiment} labelCount={view.labelCount} connected={connected} />
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
