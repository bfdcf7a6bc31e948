import { createContext, type ReactNode, useContext, useEffect, useState, useSyncExternalStore } from "react";
import { Outbox, type OutboxState } from "./outbox";
import { sendOperation } from "./send";

const OutboxContext = createContext<Outbox | null>(null);

/** One outbox for the signed-in user, whichever page is open: labels go on being sent after labelling is left. */
export function OutboxProvider({ userId, children }: { userId: string; children: ReactNode }) {
  const [outbox, setOutbox] = useState<Outbox | null>(null);
  useEffect(() => {
    const opened = new Outbox(userId, window.localStorage, sendOperation);
    const retry = () => opened.retryNow();
    window.addEventListener("online", retry);
    setOutbox(opened);
    return () => {
      window.removeEventListener("online", retry);
      opened.stop();
    };
  }, [userId]);
  return outbox && <OutboxContext value={outbox}>{children}</OutboxContext>;
}

export function useOutbox(): Outbox {
  const outbox = useContext(OutboxContext);
  if (!outbox) throw new Error("useOutbox needs an OutboxProvider above it");
  return outbox;
}

export function useOutboxState(): OutboxState {
  const outbox = useOutbox();
  return useSyncExternalStore(outbox.watch, outbox.state);
}
