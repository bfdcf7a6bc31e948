import { infiniteQueryOptions, queryOptions } from "@tanstack/react-query";
import { api, unwrap } from "./client";
import { ApiError, isPassing } from "./errors";

const byExperiment = (id: string) => ({ params: { path: { experiment_id: id } } });

/** Read queries of the API: one place for keys, so that live events know what to update. */
export const meQuery = queryOptions({
  queryKey: ["me"],
  queryFn: () => unwrap(api.GET("/api/v1/me")),
  staleTime: 60_000,
});

export const tasksQuery = queryOptions({
  queryKey: ["tasks"],
  queryFn: () => unwrap(api.GET("/api/v1/tasks")),
  staleTime: Number.POSITIVE_INFINITY,
});

export const experimentsQuery = infiniteQueryOptions({
  queryKey: ["experiments"],
  queryFn: ({ pageParam: cursor }) =>
    unwrap(api.GET("/api/v1/experiments", { params: { query: { limit: 50, cursor } } })),
  initialPageParam: null as string | null,
  getNextPageParam: (page) => page.next_cursor,
  refetchInterval: 5_000,
});

export const experimentQuery = (id: string) =>
  queryOptions({
    queryKey: ["experiment", id],
    queryFn: () => unwrap(api.GET("/api/v1/experiments/{experiment_id}", byExperiment(id))),
    // Live events bring changes at once; this is the net below them.
    refetchInterval: 15_000,
  });

export const metricsQuery = (id: string) =>
  queryOptions({
    queryKey: ["metrics", id],
    queryFn: () => unwrap(api.GET("/api/v1/experiments/{experiment_id}/metrics", byExperiment(id))),
  });

export const rewardVersionsQuery = (id: string) =>
  queryOptions({
    queryKey: ["reward-versions", id],
    queryFn: () => unwrap(api.GET("/api/v1/experiments/{experiment_id}/reward-versions", byExperiment(id))),
  });

export const workersQuery = queryOptions({
  queryKey: ["workers"],
  queryFn: () => unwrap(api.GET("/api/v1/workers")),
  refetchInterval: 10_000,
});

/** Tries again what may pass by itself; what the server refused stays refused. */
export function shouldRetry(failures: number, error: unknown): boolean {
  return isPassing(error) && !(error instanceof ApiError && error.status === 401) && failures < 5;
}
