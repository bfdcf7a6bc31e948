import { createContext, type ReactNode, useContext, useEffect, useState, useSyncExternalStore } from "react";
import { Outbox, type OutboxState } from "./outbox";
import { send } from "./send";

const OutboxContext = createContext<Outbox | null>(null);

/** Provides one outbox for the signed-in user on every page, so that labels are sent after leaving the label page. */
export function OutboxProvider({ userId, children }: { userId: string; children: ReactNode }) {
  const [outbox, setOutbox] = useState<Outbox | null>(null);
  useEffect(() => {
    const created = new Outbox(userId, window.localStorage, send);
    const retry = () => created.retryNow();
    window.addEventListener("online", retry);
    setOutbox(created);
    return () => {
      window.removeEventListener("online", retry);
      created.stop();
    };
  }, [userId]);
  return outbox && <OutboxContext value={outbox}>{children}</OutboxContext>;
}

export function useOutbox(): Outbox {
  const outbox = useContext(OutboxContext);
  if (!outbox) throw new Error("useOutbox must be used inside an OutboxProvider");
  return outbox;
}

export function useOutboxState(): OutboxState {
  const outbox = useOutbox();
  return useSyncExternalStore(outbox.subscribe, outbox.state);
}
