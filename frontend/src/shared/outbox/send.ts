import { api, unwrap } from "@/shared/api/client";
import { ApiError } from "@/shared/api/errors";
import type { Operation } from "./store";

/** Large enough that a pair released a moment ago is among the ones the server offers next. */
const LEASE_COUNT = 8;

/** Sends one operation to the server. Idempotent: sending the same operation twice changes nothing. */
export async function sendOperation(operation: Operation): Promise<unknown> {
  const { experimentId, queryId } = operation;
  const query = { params: { path: { query_id: queryId } } };
  if (operation.kind === "undo") return unwrap(api.DELETE("/api/v1/queries/{query_id}/label", query));
  const putLabel = () =>
    unwrap(api.PUT("/api/v1/queries/{query_id}/label", { ...query, body: operation.body }));
  try {
    return await putLabel();
  } catch (error) {
    if (!(error instanceof ApiError && error.code === "lease_lost")) throw error;
    // The lease was released, for example by a page that closed. If nobody else holds the pair, a new lease makes the
    // label valid again.
    if (!(await leaseAgain(experimentId, queryId))) throw error;
    return putLabel();
  }
}

/** Leases the next queries; returns whether this one is among them. */
async function leaseAgain(experimentId: string, queryId: string): Promise<boolean> {
  const { items } = await unwrap(
    api.POST("/api/v1/experiments/{experiment_id}/queries/next", {
      params: { path: { experiment_id: experimentId }, query: { count: LEASE_COUNT } },
    }),
  );
  return items.some(({ id }) => id === queryId);
}
