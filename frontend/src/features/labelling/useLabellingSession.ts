import { useEffect, useState, useSyncExternalStore } from "react";
import { useOutbox } from "@/shared/outbox/context";
import { labellingServer } from "./server";
import { LabellingSession, type SessionView } from "./session";

const NOTHING_YET: SessionView = {
  ...{ current: null, upcoming: [], last: null, flash: null },
  ...{ reason: null, trouble: null, notice: null, labelled: 0, shown: 0 },
};

const SIGNS_OF_LIFE = ["keydown", "pointerdown", "pointermove"] as const;

const noWatch = () => () => undefined;
const nothingYet = () => NOTHING_YET;

/** The labelling session of one experiment while this page is open; null for the moment before it begins. */
export function useLabellingSession(
  experimentId: string,
  userId: string,
): { session: LabellingSession | null; view: SessionView } {
  const outbox = useOutbox();
  const [session, setSession] = useState<LabellingSession | null>(null);
  useEffect(() => {
    const opened = new LabellingSession({
      experimentId,
      server: labellingServer(experimentId),
      outbox,
      storage: window.sessionStorage,
      storageKey: `accord.session.${userId}.${experimentId}`,
    });
    const leave = () => opened.dispose();
    const comeBack = (event: PageTransitionEvent) => {
      if (event.persisted) window.location.reload();
    };
    const look = () => {
      if (document.visibilityState === "visible") opened.wake();
    };
    const seen = () => opened.seen();
    for (const sign of SIGNS_OF_LIFE) window.addEventListener(sign, seen);
    window.addEventListener("pagehide", leave);
    window.addEventListener("pageshow", comeBack);
    document.addEventListener("visibilitychange", look);
    setSession(opened);
    return () => {
      for (const sign of SIGNS_OF_LIFE) window.removeEventListener(sign, seen);
      window.removeEventListener("pagehide", leave);
      window.removeEventListener("pageshow", comeBack);
      document.removeEventListener("visibilitychange", look);
      opened.dispose();
    };
  }, [experimentId, userId, outbox]);
  const view = useSyncExternalStore(session?.watch ?? noWatch, session?.view ?? nothingYet);
  return { session, view };
}
