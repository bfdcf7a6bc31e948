import { api, unwrap } from "@/shared/api/client";
import { ApiError } from "@/shared/api/errors";
import type { Operation } from "./outbox";

/** Enough for a pair given up a moment ago to be among those that the server offers again. */
const OFFERED_AGAIN = 8;

/** Tells the server of one operation. Sending the same one twice changes nothing. */
export async function sendOperation(operation: Operation): Promise<unknown> {
  const { experimentId, queryId } = operation;
  const query = { params: { path: { query_id: queryId } } };
  if (operation.kind === "undo") return unwrap(api.DELETE("/api/v1/queries/{query_id}/label", query));
  const put = () => unwrap(api.PUT("/api/v1/queries/{query_id}/label", { ...query, body: operation.body }));
  try {
    return await put();
  } catch (error) {
    if (!(error instanceof ApiError && error.code === "lease_lost")) throw error;
    // The pair was given up, for example by a page that closed. If it is nobody's, the server offers it again, and
    // what was said of it still holds.
    if (!(await isOfferedAgain(experimentId, queryId))) throw error;
    return put();
  }
}

async function isOfferedAgain(experimentId: string, queryId: string): Promise<boolean> {
  const { items } = await unwrap(
    api.POST("/api/v1/experiments/{experiment_id}/queries/next", {
      params: { path: { experiment_id: experimentId }, query: { count: OFFERED_AGAIN } },
    }),
  );
  return items.some(({ id }) => id === queryId);
}
