import { useMutation } from "@tanstack/react-query";
import { useCallback, useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { errorMessage } from "@/shared/api/errors";
import type { Experiment, Query } from "@/shared/api/types";
import { Alert } from "@/shared/ui/Message";
import { ChoiceButtons } from "./ChoiceButtons";
import { ClipPair } from "./ClipPair";
import { type Choice, choiceOf, hasSlight, LABELS, MIN_RESPONSE_SECONDS, sideOf } from "./choices";
import { type Command, useKeyboardCommands } from "./commands";
import { AgentLegend } from "./ExperimentSummary";
import { GuideDialog } from "./GuideDialog";
import { RulesButton, RulesDialog } from "./Instructions";
import { KeyList } from "./keys";
import { useClipNames } from "./layout";
import { PlaybackControls } from "./PlaybackControls";
import { Feedback, type PracticeResult, PracticeSummary } from "./PracticeFeedback";
import { useStage } from "./stage";
import "./practice.css";

interface PracticeViewProps {
  experiment: Experiment;
  pairs: readonly Query[];
  /** back to where the practice began */
  onLeave: () => void;
  onStartLabelling: () => void;
}

/** Pairs whose answer a researcher knows, with the same keys as labelling, and feedback after each. */
export function PracticeView({ experiment, pairs, onLeave, onStartLabelling }: PracticeViewProps) {
  const [results, setResults] = useState<readonly PracticeResult[]>([]);
  const [index, setIndex] = useState(0);
  const [guide, setGuide] = useState<"rules" | "keys" | null>(null);
  const names = useClipNames();
  const slight = hasSlight(experiment);
  const current = pairs[index] ?? null;
  const result = results[index];
  const stage = useStage(experiment.task, current, pairs.slice(index + 1, index + 3), index);
  const answer = useMutation({
    mutationFn: ({ pair, choice }: { pair: Query; choice: Choice }) =>
      unwrap(
        api.PUT("/api/v1/queries/{query_id}/practice", {
          params: { path: { query_id: pair.id } },
          body: { label: LABELS[choice] },
        }),
      ),
    onSuccess: (feedback, given) => setResults((earlier) => [...earlier, { ...given, feedback }]),
  });
  const { mutate, isPending } = answer;
  const { player, run: play } = stage;
  const run = useCallback(
    (command: Command) => {
      if (command.type === "choose") {
        const watched = player.watchedSeconds() ?? 0;
        if (current && !result && !isPending && watched >= MIN_RESPONSE_SECONDS)
          mutate({
            pair: current,
            choice: slight ? command.choice : (sideOf(command.choice) ?? command.choice),
          });
      } else if (command.type === "showRules") setGuide("rules");
      else if (command.type === "showKeys") setGuide("keys");
      else if (command.type === "next" && result) setIndex(index + 1);
      else play(command);
    },
    [player, play, current, result, isPending, mutate, index, slight],
  );
  useKeyboardCommands(run);

  if (!current)
    return (
      <PracticeSummary
        results={results}
        names={names}
        onAgain={() => {
          answer.reset();
          setResults([]);
          setIndex(0);
        }}
        onStart={onStartLabelling}
      />
    );
  const choice = answer.variables?.pair === current && !answer.error ? answer.variables.choice : null;
  return (
    <main className="label-page" id="content">
      <div className="label-view">
        <div className="practice-banner" data-testid="practice">
          <h1>
            Practice: answers do not count. Pair {index + 1} of {pairs.length}
          </h1>
          <RulesButton onOpen={() => setGuide("rules")} />
          <button type="button" className="button small" onClick={onLeave}>
            End practice
          </button>
        </div>
        <ClipPair
          query={current}
          experiment={experiment}
          stage={stage}
          upcoming={pairs.length - index - 1}
          chosen={result ? choiceOf(result.feedback.label) : choice}
          names={names}
          onChoose={(each) => run({ type: "choose", choice: each })}
          onAgents={null}
        />
        <div className="answer-bar">
          {answer.error && <Alert>{errorMessage(answer.error)}</Alert>}
          {result ? (
            <Feedback
              result={result}
              names={names}
              isLast={index + 1 === pairs.length}
              onNext={() => setIndex(index + 1)}
            />
          ) : (
            <ChoiceButtons
              enabled={player.state === "playing"}
              canSkip={player.state === "playing"}
              chosen={choice}
              slight={slight}
              names={names}
              onChoose={(each) => run({ type: "choose", choice: each })}
            />
          )}
        </div>
        <PlaybackControls stage={stage} onCommand={run} />
        <div className="summary">
          <AgentLegend experiment={experiment} />
        </div>
      </div>
      {guide === "rules" && <RulesDialog experiment={experiment} onClose={() => setGuide(null)} />}
      {guide === "keys" && (
        <GuideDialog title="Keys" onClose={() => setGuide(null)}>
          <KeyList slight={slight} agents={false} />
        </GuideDialog>
      )}
    </main>
  );
}
