import { type QueryClient, useQueryClient } from "@tanstack/react-query";
import { useEffect, useState } from "react";
import { mergeMetrics } from "@/shared/api/metrics";
import {
  experimentQuery,
  meQuery,
  metricsQuery,
  rewardVersionsQuery,
  workersQuery,
} from "@/shared/api/queries";
import type { Experiment, Metrics, Worker } from "@/shared/api/types";

const RECONNECT_SECONDS = 2;

/**
 * Keeps the cache of one experiment up to date from its live events, and says whether the events flow.
 *
 * The browser reconnects by itself after a lost connection; a connection that was refused (a server that is
 * just starting, a lost sign-in) is opened anew here.
 */
export function useLive(experimentId: string): boolean {
  const cache = useQueryClient();
  const [live, setLive] = useState(true);
  useEffect(() => {
    let source: EventSource | null = null;
    let timer = 0;
    const open = () => {
      source = new EventSource(`/api/v1/experiments/${encodeURIComponent(experimentId)}/events`);
      listen(source, cache, experimentId);
      source.addEventListener("open", () => {
        setLive(true);
        refresh(cache, experimentId);
      });
      source.addEventListener("error", () => {
        setLive(false);
        if (source?.readyState !== EventSource.CLOSED) return;
        void cache.invalidateQueries({ queryKey: meQuery.queryKey });
        timer = window.setTimeout(open, RECONNECT_SECONDS * 1000);
      });
    };
    open();
    return () => {
      window.clearTimeout(timer);
      source?.close();
    };
  }, [cache, experimentId]);
  return live;
}

function listen(source: EventSource, cache: QueryClient, id: string): void {
  source.addEventListener("experiment", (event) => {
    const fresh = JSON.parse(event.data) as Experiment;
    const old = cache.getQueryData(experimentQuery(id).queryKey);
    cache.setQueryData(experimentQuery(id).queryKey, fresh);
    if (old?.reward_version !== fresh.reward_version) {
      void cache.invalidateQueries({ queryKey: rewardVersionsQuery(id).queryKey });
    }
  });
  source.addEventListener("metrics", (event) => {
    const fresh = JSON.parse(event.data) as Metrics;
    cache.setQueryData(metricsQuery(id).queryKey, (old) => mergeMetrics(old, fresh));
  });
  source.addEventListener("workers", (event) => {
    cache.setQueryData(workersQuery.queryKey, JSON.parse(event.data) as Worker[]);
  });
}

/** What happened while no events flowed is read once. */
function refresh(cache: QueryClient, id: string): void {
  for (const { queryKey } of [experimentQuery(id), metricsQuery(id), rewardVersionsQuery(id), workersQuery]) {
    void cache.invalidateQueries({ queryKey });
  }
}
