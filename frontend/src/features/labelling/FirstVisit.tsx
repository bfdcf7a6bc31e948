import type { Experiment, Query } from "@/shared/api/types";
import { LazyMarkdown } from "@/shared/markdown/LazyMarkdown";
import { asksAgent, hasSlight } from "./choices";
import { KeyList } from "./keys";
import { PractiseButton } from "./PractiseButton";

interface FirstVisitProps {
  experiment: Experiment;
  /** whether the labeller has seen an earlier revision of the rules */
  isUpdate: boolean;
  onStart: () => void;
  onPractise: (pairs: readonly Query[]) => void;
}

/** The rules and the keys, before the first pair and after every change of the rules. No pair is held meanwhile. */
export function FirstVisit({ experiment, isUpdate, onStart, onPractise }: FirstVisitProps) {
  return (
    <main className="page narrow first-visit" id="content">
      <h1>{isUpdate ? "The rules have changed" : "Before you start"}</h1>
      <section className="card" aria-labelledby="rules-title">
        <h2 id="rules-title">What to look for</h2>
        <LazyMarkdown text={experiment.instructions} />
      </section>
      {!isUpdate && (
        <section className="card" aria-labelledby="how-title">
          <h2 id="how-title">How to answer</h2>
          <p>
            You see two clips side by side. Choose the one that follows the rules better. If you cannot tell,
            skip the pair. You can undo and change your answers.
          </p>
          <p className="for-touch">Tap the better clip, or one of the buttons below the clips.</p>
          <div className="for-keys">
            <KeyList slight={hasSlight(experiment)} agents={asksAgent(experiment)} />
          </div>
        </section>
      )}
      <div className="row">
        {/* biome-ignore lint/a11y/noAutofocus: Enter starts, so that no mouse is needed */}
        <button type="button" className="button primary" autoFocus onClick={onStart}>
          Start labelling
        </button>
        <PractiseButton experiment={experiment} onPractise={onPractise} />
      </div>
    </main>
  );
}
