import { useCallback, useEffect, useRef, useState } from "react";
import type { Experiment, Query } from "@/shared/api/types";
import type { ClipSource } from "@/shared/media/clip";
import { ClipCache } from "@/shared/media/clipCache";
import { usePairPlayer } from "@/shared/media/usePairPlayer";
import { isOver } from "@/shared/ui/status";
import { ChoiceButtons } from "./ChoiceButtons";
import { ClipPair } from "./ClipPair";
import { type Choice, hasSlight, sideOf } from "./choices";
import { useCamera, useClipViews } from "./clipViews";
import { type Command, useKeyboardCommands } from "./commands";
import { ExperimentSummary } from "./ExperimentSummary";
import { GuideDialog } from "./GuideDialog";
import { HistoryPanel } from "./HistoryPanel";
import { Instructions, RulesDialog } from "./Instructions";
import { KeyList } from "./keys";
import { useClipNames } from "./layout";
import { NoPair } from "./NoPair";
import { PaceNotice, usePace } from "./PaceNotice";
import { PlaybackControls } from "./PlaybackControls";
import { usePairNotification } from "./pairNotification";
import { ReviewBanner } from "./ReviewBanner";
import { StatusLine } from "./StatusLine";
import { useLabellingSession } from "./useLabellingSession";

/** Nobody compares two clips faster than this: an earlier key press was meant for the previous pair. */
const MIN_RESPONSE_SECONDS = 0.3;

const DECIDES = "People disagree on these pairs. Your answer is final: training uses it in place of theirs.";

interface LabelViewProps {
  experiment: Experiment;
  connected: boolean;
  /** whether the labels decide pairs on which those of others differ */
  decides?: boolean;
}

/** The instructions, the pair of clips, the choices, and the progress of the experiment. */
export function LabelView({ experiment, connected, decides = false }: LabelViewProps) {
  const { session, view } = useLabellingSession(experiment.id, decides, experiment.instructions_revision);
  const names = useClipNames();
  const pace = usePace();
  const addToPace = pace.add;
  const [historyOpen, setHistoryOpen] = useState(false);
  const [guide, setGuide] = useState<"rules" | "keys" | null>(null);
  const [clips] = useState(() => new ClipCache());
  const left = useRef<HTMLCanvasElement>(null);
  const right = useRef<HTMLCanvasElement>(null);
  const progress = useRef<HTMLDivElement>(null);
  const { upcoming, reviewed } = view;
  const last = view.history.at(-1);
  const over = isOver(experiment);
  const slight = hasSlight(experiment);
  const current = over ? (reviewed?.query ?? null) : view.current;
  const { cameras, camera, setCamera } = useCamera(experiment.task);
  const views = useClipViews(camera, [current, upcoming[0]].filter(isPair));
  const [leftClip, rightClip] = current ? views.sourcesOf(current) : [null, null];
  const player = usePairPlayer(clips, leftClip, rightClip, view.displayCount, { left, right, progress });

  const sources = [current, ...upcoming, last?.query].filter(isPair).flatMap(views.sourcesOf).filter(isClip);
  const urls = sources.map(({ url }) => url).join();
  // biome-ignore lint/correctness/useExhaustiveDependencies: the sources change with their addresses
  useEffect(() => clips.prefetch(sources), [clips, urls]);
  useEffect(() => () => clips.clear(), [clips]);

  // biome-ignore lint/correctness/useExhaustiveDependencies: after these changes there may be new pairs
  useEffect(() => {
    if (!session?.view().current) session?.refresh();
  }, [session, experiment.status, experiment.phase, experiment.labels.open_queries, connected]);

  const choose = useCallback(
    (choice: Choice) => {
      const watched = player.watchedSeconds();
      if (watched !== null && watched >= MIN_RESPONSE_SECONDS) {
        if (!session?.view().chosen) addToPace(choice, watched);
        session?.choose(choice, watched);
      } else if (player.state === "failed" && choice === "skip") session?.choose(choice, 0);
    },
    [session, player, addToPace],
  );
  const run = useCallback(
    (command: Command) => {
      if (command.type === "choose" && !over)
        choose(slight ? command.choice : (sideOf(command.choice) ?? command.choice));
      else if (command.type === "undo") session?.undo();
      else if (command.type === "closeReview") session?.closeReview();
      else if (command.type === "toggleHistory") setHistoryOpen((open) => !open);
      else if (command.type === "showRules") setGuide("rules");
      else if (command.type === "showKeys") setGuide("keys");
      else if (command.type === "togglePause") player.togglePause();
      else if (command.type === "step") player.step(command.direction);
      else if (command.type === "setSpeed") player.setSpeed(command.speed);
      else if (command.type === "nextCamera")
        setCamera(cameras[(cameras.indexOf(camera) + 1) % cameras.length] ?? "follow");
    },
    [choose, session, player, over, slight, cameras, camera, setCamera],
  );
  useKeyboardCommands(run);
  usePairNotification(experiment.name, current !== null);

  const onChoose = (choice: Choice) => run({ type: "choose", choice });
  const showRules = () => run({ type: "showRules" });
  const closeReview = () => run({ type: "closeReview" });
  const review = (id: string) => {
    session?.review(id);
    window.scrollTo(0, 0);
  };

  return (
    <main className="label-page" id="content" data-history={historyOpen || undefined}>
      <PaceNotice visible={pace.isHasty} onDismiss={pace.dismiss} />
      <div className="label-view">
        {reviewed ? (
          <ReviewBanner
            experiment={experiment}
            pair={reviewed}
            names={names}
            onRules={showRules}
            onClose={closeReview}
          />
        ) : (
          <Instructions
            text={decides ? `${DECIDES} ${experiment.instructions}` : experiment.instructions}
            onOpen={showRules}
          />
        )}
        {current ? (
          <ClipPair
            query={current}
            task={experiment.task}
            camera={camera}
            view={views.stateOf(current)}
            rendersClips={experiment.config.render_clips !== false}
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
            slight={slight}
            names={names}
            onChoose={onChoose}
          />
        </div>
        <PlaybackControls
          player={player}
          canUndo={last !== undefined || view.chosen !== null}
          historyOpen={historyOpen}
          cameras={cameras}
          camera={camera}
          onCommand={run}
          onCamera={setCamera}
        />
        <ExperimentSummary experiment={experiment} view={view} connected={connected} />
      </div>
      {guide === "rules" && <RulesDialog text={experiment.instructions} onClose={() => setGuide(null)} />}
      {guide === "keys" && (
        <GuideDialog title="Keys" onClose={() => setGuide(null)}>
          <KeyList slight={slight} />
        </GuideDialog>
      )}
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

const isPair = (query: Query | null | undefined): query is Query => Boolean(query);
const isClip = (source: ClipSource | null): source is ClipSource => source !== null;
