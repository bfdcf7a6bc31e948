import { api, unwrap } from "@/shared/api/client";
import { ApiError } from "@/shared/api/errors";
import type { Send } from "./outbox";

/**
 * Creates the function that sends operations to the server. Sending the same operation twice changes nothing.
 *
 * Each label names the revision that it replaces, so that it never overwrites one that another tab has written. The
 * revision of a label that was given and changed while the server was away is known only once the server has
 * acknowledged it.
 */
export function createSend(): Send {
  const acknowledged = new Map<string, number>();
  return async (operation) => {
    const { queryId } = operation;
    const known = acknowledged.get(queryId) ?? 0;
    if (operation.kind === "undo") {
      await undo(queryId, Math.max(known, operation.replaces ?? 0), operation.tab);
      acknowledged.delete(queryId);
      return null;
    }
    const replaces = Math.max(known, operation.body.replaces ?? 0);
    const label = await unwrap(
      api.PUT("/api/v1/queries/{query_id}/label", {
        params: { path: { query_id: queryId } },
        body: { ...operation.body, replaces },
      }),
    );
    acknowledged.set(queryId, label.revision);
    return label;
  };
}

async function undo(queryId: string, replaces: number, tab = ""): Promise<void> {
  const query = replaces > 0 ? { tab, replaces } : { tab };
  try {
    await unwrap(
      api.DELETE("/api/v1/queries/{query_id}/label", { params: { path: { query_id: queryId }, query } }),
    );
  } catch (error) {
    // An earlier attempt has undone it, and its response was lost.
    if (!(error instanceof ApiError && error.code === "label_not_found")) throw error;
  }
}
