import { useQuery } from "@tanstack/react-query";
import { useEffect, useRef, useState } from "react";
import { rewardVersionsQuery } from "@/shared/api/queries";
import type { Experiment } from "@/shared/api/types";
import { formatPercent } from "@/shared/ui/words";
import { WORDS } from "./answers";
import type { SessionView } from "./session";
import { holdoutAccuracy } from "./version";

const NEWS_SECONDS = 12;

/** One quiet line: what was just said, and news of the reward model. It has its room even when it is empty. */
export function StatusLine({ view, experiment }: { view: SessionView; experiment: Experiment }) {
  const news = useVersionNews(experiment);
  const said = view.notice ?? (view.last ? `${WORDS[view.last.answer]}. Z brings that pair back.` : "");
  return (
    <div className="status">
      <span role="status" aria-live="polite" data-testid="status">
        {said}
      </span>
      <span
        role="status"
        aria-live="polite"
        data-testid="version-news"
        className="news"
        data-fresh={news !== ""}
      >
        {news}
      </span>
    </div>
  );
}

/** A sentence for a while after a new reward version has appeared. */
function useVersionNews(experiment: Experiment): string {
  const number = experiment.reward_version;
  const seen = useRef(number);
  const [fresh, setFresh] = useState<number | null>(null);
  const { data } = useQuery(rewardVersionsQuery(experiment.id));
  useEffect(() => {
    if (number === seen.current) return;
    seen.current = number;
    setFresh(number);
    const timer = setTimeout(() => setFresh(null), NEWS_SECONDS * 1000);
    return () => clearTimeout(timer);
  }, [number]);
  if (fresh === null) return "";
  const accuracy = holdoutAccuracy(data?.items.find((version) => version.number === fresh));
  const agrees =
    accuracy === null ? "" : ` It agrees with ${formatPercent(accuracy)} of the labels it was not shown.`;
  return `Your labels are in: reward version ${fresh} is ready.${agrees}`;
}
