import { infiniteQueryOptions, queryOptions } from "@tanstack/react-query";
import { api, unwrap } from "./client";
import { ApiError, isTransient } from "./errors";
import type { operations } from "./schema";

const byExperiment = (id: string) => ({ params: { path: { experiment_id: id } } });

// All query keys are defined here, so that live events know which entries of the cache to update.
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

/** The key of all lists of experiments. */
export const experimentsKey = ["experiments"];

export const experimentsQuery = (archived: boolean) =>
  infiniteQueryOptions({
    queryKey: [...experimentsKey, archived],
    queryFn: ({ pageParam: cursor }) =>
      unwrap(api.GET("/api/v1/experiments", { params: { query: { limit: 50, cursor, archived } } })),
    initialPageParam: null as string | null,
    getNextPageParam: (page) => page.next_cursor,
    refetchInterval: 5_000,
  });

export const experimentQuery = (id: string) =>
  queryOptions({
    queryKey: ["experiment", id],
    queryFn: () => unwrap(api.GET("/api/v1/experiments/{experiment_id}", byExperiment(id))),
    // Live events bring changes at once; polling covers a lost connection.
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

export const costsQuery = (id: string) =>
  queryOptions({
    queryKey: ["costs", id],
    queryFn: () => unwrap(api.GET("/api/v1/experiments/{experiment_id}/costs", byExperiment(id))),
  });

/** Which queries to list, as the API's parameters; null does not filter. */
export type LabelFilters = Pick<
  NonNullable<operations["list_queries"]["parameters"]["query"]>,
  "status" | "user" | "label" | "changed"
>;

export const queriesQuery = (id: string, filters: LabelFilters) =>
  infiniteQueryOptions({
    queryKey: ["queries", id, filters],
    queryFn: ({ pageParam: before }) =>
      unwrap(
        api.GET("/api/v1/experiments/{experiment_id}/queries", {
          params: { path: { experiment_id: id }, query: { ...filters, before } },
        }),
      ),
    initialPageParam: null as number | null,
    getNextPageParam: (page) => page.next_before,
  });

/** Where the browser downloads the same queries as CSV. */
export function queriesCsvUrl(id: string, filters: LabelFilters): string {
  const given = Object.entries(filters).filter(([, value]) => value !== null);
  const query = new URLSearchParams(given.map(([name, value]) => [name, String(value)]));
  return `/api/v1/experiments/${encodeURIComponent(id)}/queries.csv?${query}`;
}

export const workersQuery = queryOptions({
  queryKey: ["workers"],
  queryFn: () => unwrap(api.GET("/api/v1/workers")),
  refetchInterval: 10_000,
});

/** Retries transient errors up to five times. A 401 is not retried: the user has to sign in. */
export function shouldRetry(failures: number, error: unknown): boolean {
  return isTransient(error) && !(error instanceof ApiError && error.status === 401) && failures < 5;
}
