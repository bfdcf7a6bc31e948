import type { PracticeFeedback, Query } from "@/shared/api/types";
import { Key } from "@/shared/ui/Key";
import { type Choice, choiceOf } from "./choices";
import { type ClipNames, choiceText } from "./layout";

/** An answer to a practice pair with what the server said of it. */
export interface PracticeResult {
  pair: Query;
  choice: Choice;
  feedback: PracticeFeedback;
}

interface FeedbackProps {
  result: PracticeResult;
  names: ClipNames;
  isLast: boolean;
  onNext: () => void;
}

/** Whether an answer was the known one, and why, in place of the buttons that gave it. */
export function Feedback({ result, names, isLast, onNext }: FeedbackProps) {
  return (
    <div className="practice-feedback" data-correct={result.feedback.is_correct}>
      <p role="status" data-testid="feedback">
        {verdict(result, names)}
      </p>
      {/* biome-ignore lint/a11y/noAutofocus: Enter goes on, so that no mouse is needed */}
      <button type="button" className="button primary" autoFocus onClick={onNext}>
        <Key name="Enter" /> {isLast ? "Finish practice" : "Next pair"}
      </button>
    </div>
  );
}

/** "Correct", or what the researcher chose, with the explanation. */
function verdict({ feedback }: PracticeResult, names: ClipNames) {
  const chosen = `The researcher chose ${knownText(feedback.label, names)}`;
  const known = feedback.is_correct ? "✓ Correct" : chosen;
  return (
    <>
      <strong>{known}</strong>
      {feedback.explanation ? `: ${feedback.explanation}` : "."}
    </>
  );
}

function knownText(label: number, names: ClipNames): string {
  const choice = choiceOf(label);
  return choice === "left" || choice === "right" ? names[choice].toLowerCase() : "equally good";
}

interface PracticeSummaryProps {
  results: readonly PracticeResult[];
  names: ClipNames;
  onAgain: () => void;
  onStart: () => void;
}

/** How many answers were correct, and which were not. */
export function PracticeSummary({ results, names, onAgain, onStart }: PracticeSummaryProps) {
  const correct = results.filter(({ feedback }) => feedback.is_correct).length;
  return (
    <main className="page narrow first-visit" id="content">
      <h1>End of practice</h1>
      <section className="card" aria-labelledby="result-title">
        <h2 id="result-title">
          {correct} of {results.length} correct
        </h2>
        <ol className="practice-results">
          {results.map((result, index) => (
            <li key={result.pair.id}>
              Pair {index + 1}: you answered “{choiceText(result.choice, names)}”. {verdict(result, names)}
            </li>
          ))}
        </ol>
        <p>None of these answers was stored. Your next answers count.</p>
      </section>
      <div className="row">
        {/* biome-ignore lint/a11y/noAutofocus: Enter starts, so that no mouse is needed */}
        <button type="button" className="button primary" autoFocus onClick={onStart}>
          Start labelling
        </button>
        <button type="button" className="button" onClick={onAgain}>
          Practise again
        </button>
      </div>
    </main>
  );
}
