import { useCallback, useEffect, useRef, useState } from "react";
import type { Experiment, Me } from "@/shared/api/types";
import { Clips } from "@/shared/media/clips";
import { usePairPlayer } from "@/shared/media/usePairPlayer";
import { isOver } from "@/shared/ui/words";
import { AnswerBar } from "./AnswerBar";
import type { Answer, Command } from "./answers";
import { PairStage } from "./PairStage";
import { StatusLine } from "./StatusLine";
import { Strip } from "./Strip";
import { sourceOf, sourcesOf } from "./sources";
import { Transport } from "./Transport";
import { useCommands } from "./useCommands";
import { useLabellingSession } from "./useLabellingSession";
import { Waiting } from "./Waiting";

/** Nobody judges two clips in less: a key that comes sooner was meant for the pair before. */
const SHORTEST_LOOK_SECONDS = 0.3;

/** The place of work: the task, the pair, the answers, and what comes of them. */
export function Workbench({ experiment, me, live }: { experiment: Experiment; me: Me; live: boolean }) {
  const { session, view } = useLabellingSession(experiment.id, me.id);
  const [clips] = useState(() => new Clips());
  const left = useRef<HTMLCanvasElement>(null);
  const right = useRef<HTMLCanvasElement>(null);
  const position = useRef<HTMLDivElement>(null);
  const { upcoming, last } = view;
  const over = isOver(experiment);
  const current = over ? null : view.current;
  const player = usePairPlayer(
    clips,
    current && sourceOf(current.left),
    current && sourceOf(current.right),
    view.shown,
    { left, right, position },
  );

  useEffect(() => {
    clips.want(sourcesOf([current, ...upcoming, last?.query]));
  }, [clips, current, upcoming, last]);
  useEffect(() => () => clips.clear(), [clips]);

  // What the policy does next decides when there is something to label again.
  // biome-ignore lint/correctness/useExhaustiveDependencies: these changes of the experiment are what wakes it
  useEffect(() => {
    if (!session?.view().current) session?.wake();
  }, [session, experiment.status, experiment.phase, experiment.labels.open_queries, live]);

  const answer = useCallback(
    (given: Answer) => {
      const watched = player.watchedSeconds();
      if (watched !== null && watched >= SHORTEST_LOOK_SECONDS) session?.answer(given, watched);
      else if (player.state === "failed" && given === "skip") session?.answer(given, 0);
    },
    [session, player],
  );
  const obey = useCallback(
    (command: Command) => {
      if (command.do === "answer") answer(command.answer);
      else if (command.do === "undo") session?.undo();
      else if (command.do === "pause") player.togglePause();
      else if (command.do === "step") player.step(command.direction);
      else player.setSpeed(command.speed);
    },
    [answer, session, player],
  );
  useCommands(obey);

  return (
    <main className="workbench" id="content">
      <h1 className="instructions" title={experiment.instructions}>
        {experiment.instructions}
      </h1>
      {current ? (
        <PairStage
          query={current}
          ahead={upcoming.length}
          flash={view.flash}
          player={player}
          left={left}
          right={right}
          position={position}
        />
      ) : (
        <Waiting
          experiment={experiment}
          reason={over ? "experiment_over" : view.reason}
          trouble={view.trouble}
          ratio={player.ratio}
        />
      )}
      <AnswerBar
        enabled={current !== null && player.state === "playing"}
        skippable={current !== null && player.state !== "loading"}
        flash={view.flash}
        onAnswer={(given) => obey({ do: "answer", answer: given })}
      />
      <Transport player={player} canUndo={last !== null || view.flash !== null} onCommand={obey} />
      <StatusLine view={view} experiment={experiment} />
      <Strip experiment={experiment} labelled={view.labelled} live={live} />
    </main>
  );
}
