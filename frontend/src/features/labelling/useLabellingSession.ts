import { useEffect, useState, useSyncExternalStore } from "react";
import { api, unwrap } from "@/shared/api/client";
import { useOutbox } from "@/shared/outbox/OutboxProvider";
import { INITIAL_VIEW, type LabellingServer, LabellingSession, type SessionView } from "./session";

const ACTIVITY_EVENTS = ["keydown", "pointerdown", "pointermove"] as const;

const subscribeToNothing = () => () => undefined;
const initialView = () => INITIAL_VIEW;

/** The labelling session of one experiment while the page is open; null during the first render. */
export function useLabellingSession(
  experimentId: string,
  userId: string,
): { session: LabellingSession | null; view: SessionView } {
  const outbox = useOutbox();
  const [session, setSession] = useState<LabellingSession | null>(null);
  useEffect(() => {
    const created = new LabellingSession({
      experimentId,
      server: createServer(experimentId),
      outbox,
      storage: window.sessionStorage,
      storageKey: `accord.labelling.${userId}.${experimentId}`,
    });
    const onPageHide = () => created.dispose();
    // The browser restored the page from its back/forward cache, with a disposed session.
    const onPageShow = (event: PageTransitionEvent) => {
      if (event.persisted) window.location.reload();
    };
    const onVisibilityChange = () => {
      if (document.visibilityState === "visible") created.refresh();
    };
    const onActivity = () => created.userActive();
    for (const event of ACTIVITY_EVENTS) window.addEventListener(event, onActivity);
    window.addEventListener("pagehide", onPageHide);
    window.addEventListener("pageshow", onPageShow);
    document.addEventListener("visibilitychange", onVisibilityChange);
    setSession(created);
    return () => {
      for (const event of ACTIVITY_EVENTS) window.removeEventListener(event, onActivity);
      window.removeEventListener("pagehide", onPageHide);
      window.removeEventListener("pageshow", onPageShow);
      document.removeEventListener("visibilitychange", onVisibilityChange);
      created.dispose();
    };
  }, [experimentId, userId, outbox]);
  const view = useSyncExternalStore(session?.subscribe ?? subscribeToNothing, session?.view ?? initialView);
  return { session, view };
}

function createServer(experimentId: string): LabellingServer {
  const pathOf = (queryId: string) => ({ params: { path: { query_id: queryId } } });
  return {
    next: (count) =>
      unwrap(
        api.POST("/api/v1/experiments/{experiment_id}/queries/next", {
          params: { path: { experiment_id: experimentId }, query: { count } },
        }),
      ),
    heartbeat: (queryId) => unwrap(api.PUT("/api/v1/queries/{query_id}/lease", pathOf(queryId))),
    release: (queryId) => {
      // `keepalive` completes the request even if the page is closing. A failure needs no handling: the lease expires.
      api
        .DELETE("/api/v1/queries/{query_id}/lease", { ...pathOf(queryId), keepalive: true })
        .catch(() => undefined);
    },
  };
}
