import { useQuery } from "@tanstack/react-query";
import { meQuery } from "@/shared/api/queries";
import { canManageExperiments, type Experiment } from "@/shared/api/types";
import { gifUrl } from "@/shared/media/clip";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { Key } from "@/shared/ui/Key";
import { RulesButton } from "./Instructions";
import { answerText, type ClipNames } from "./layout";
import type { AnsweredPair } from "./queue";

interface ReviewBannerProps {
  experiment: Experiment;
  pair: AnsweredPair;
  names: ClipNames;
  onRules: () => void;
  onClose: () => void;
}

/** Says that an answered pair is on screen, and how to keep or change its label. */
export function ReviewBanner({ experiment, pair, names, onRules, onClose }: ReviewBannerProps) {
  const { data: me } = useQuery(meQuery);
  const showsCredit = experiment.config.show_credit === true || (me && canManageExperiments(me));
  return (
    <div className="review-banner" role="status">
      <h1>
        Pair {pair.query.number}, answered “{answerText(pair, names, experiment.task)}”. Answer again to
        change it.
      </h1>
      {showsCredit && experiment.reward_version !== null && (
        <Link to={paths.pair(experiment.id, pair.query.id)} className="button small">
          What was learned
        </Link>
      )}
      {(["left", "right"] as const).map((side) => {
        const url = pair.query[side].clip_url;
        return (
          url && (
            <a key={side} className="button small for-keys" href={gifUrl(url)} download>
              {names[side]} as GIF
            </a>
          )
        );
      })}
      <RulesButton onOpen={onRules} />
      <button type="button" className="button small" onClick={onClose}>
        <Key name="Esc" /> Keep it
      </button>
    </div>
  );
}
