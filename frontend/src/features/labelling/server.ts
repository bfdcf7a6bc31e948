import { api, unwrap } from "@/shared/api/client";
import type { Queries } from "@/shared/api/types";

const of = (queryId: string) => ({ params: { path: { query_id: queryId } } });

/** What a labelling session asks of the server. */
export interface LabellingServer {
  next(count: number): Promise<Queries>;
  heartbeat(queryId: string): Promise<unknown>;
  release(queryId: string): void;
}

export function labellingServer(experimentId: string): LabellingServer {
  return {
    next: (count) =>
      unwrap(
        api.POST("/api/v1/experiments/{experiment_id}/queries/next", {
          params: { path: { experiment_id: experimentId }, query: { count } },
        }),
      ),
    heartbeat: (queryId) => unwrap(api.PUT("/api/v1/queries/{query_id}/lease", of(queryId))),
    release: (queryId) => {
      // The page may be closing: `keepalive` lets the request outlive it, and nobody is left to hear of a failure
      // (the lease then runs out by itself).
      api
        .DELETE("/api/v1/queries/{query_id}/lease", { ...of(queryId), keepalive: true })
        .catch(() => undefined);
    },
  };
}
