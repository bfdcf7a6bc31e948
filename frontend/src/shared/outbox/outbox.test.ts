import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { ApiError, Unreachable } from "@/shared/api/errors";
import { type Operation, Outbox } from "./outbox";
import type { Storage } from "./store";

class MemoryStorage implements Storage {
  readonly items = new Map<string, string>();
  get length() {
    return this.items.size;
  }
  key = (index: number) => [...this.items.keys()][index] ?? null;
  getItem = (key: string) => this.items.get(key) ?? null;
  setItem = (key: string, value: string) => void this.items.set(key, value);
  removeItem = (key: string) => void this.items.delete(key);
}

const label = (queryId: string) => ({
  kind: "label" as const,
  experimentId: "exp_1",
  queryId,
  body: { label: 1, order: "shown" as const },
});

/** A server that can be down and that remembers what it took. */
class Server {
  down = false;
  taken: string[] = [];
  send = async (operation: Operation) => {
    await Promise.resolve();
    if (this.down) throw new Unreachable(null);
    if (operation.queryId === "lost") throw new ApiError(410, "lease_lost", "You hold no lease.");
    this.taken.push(`${operation.kind} ${operation.queryId}`);
  };
}

let storage: MemoryStorage;
let server: Server;
const open = () => new Outbox("usr_1", storage, server.send);
const settle = () => vi.advanceTimersByTimeAsync(60_000);

beforeEach(() => {
  vi.useFakeTimers();
  storage = new MemoryStorage();
  server = new Server();
});
afterEach(() => {
  vi.useRealTimers();
});

describe("Outbox", () => {
  test("sends in order and forgets what was acknowledged", async () => {
    const outbox = open();
    outbox.put(label("a"));
    outbox.put(label("b"));
    expect(outbox.state().unsent).toBe(2);
    await settle();
    expect(server.taken).toEqual(["label a", "label b"]);
    expect(outbox.state()).toEqual({ unsent: 0, trouble: null });
    expect(storage.items.size).toBe(0);
  });

  test("a server that is down is tried again until it takes the label", async () => {
    const outbox = open();
    server.down = true;
    outbox.put(label("a"));
    await settle();
    expect(outbox.state().unsent).toBe(1);
    expect(outbox.state().trouble).toContain("does not answer");
    server.down = false;
    await settle();
    expect(server.taken).toEqual(["label a"]);
    expect(outbox.state()).toEqual({ unsent: 0, trouble: null });
  });

  test("trouble is over only when everything that waited is sent", async () => {
    const outbox = open();
    server.down = true;
    outbox.put(label("a"));
    outbox.put(label("b"));
    await settle();
    const states: string[] = [];
    outbox.watch(() =>
      states.push(`${outbox.state().unsent} ${outbox.state().trouble ? "trouble" : "well"}`),
    );
    server.down = false;
    await settle();
    expect(states).toEqual(["1 trouble", "0 well"]);
  });

  test("a reload goes on where the last page stopped, in the same order", async () => {
    server.down = true;
    const before = open();
    for (const id of ["a", "b", "c"]) before.put(label(id));
    await settle();
    before.stop();
    server.down = false;
    open();
    await settle();
    expect(server.taken).toEqual(["label a", "label b", "label c"]);
  });

  test("another user of the same browser does not send them", async () => {
    server.down = true;
    open().put(label("a"));
    await vi.advanceTimersByTimeAsync(0);
    const other = new Outbox("usr_2", storage, server.send);
    expect(other.state().unsent).toBe(0);
  });

  test("a refused label is dropped and told, and the next one goes", async () => {
    const outbox = open();
    const outcomes: string[] = [];
    outbox.listen(({ operation, refused }) =>
      outcomes.push(`${operation.queryId} ${refused ? "refused" : "taken"}`),
    );
    outbox.put(label("lost"));
    outbox.put(label("a"));
    await settle();
    expect(outcomes).toEqual(["lost refused", "a taken"]);
    expect(storage.items.size).toBe(0);
  });

  test("a label that has not left is taken back without the server", async () => {
    const outbox = open();
    outbox.put(label("a"));
    outbox.put(label("b"));
    expect(outbox.takeBack("b")).toBe(true);
    expect(outbox.takeBack("a")).toBe(false); // on its way
    await settle();
    expect(server.taken).toEqual(["label a"]);
  });

  test("label, undo, label of one query arrive in this order, and it counts as labelled only then", async () => {
    const outbox = open();
    outbox.put(label("a"));
    outbox.put({ kind: "undo", experimentId: "exp_1", queryId: "a" });
    expect(outbox.labelled()).toEqual(new Set());
    outbox.put(label("a"));
    expect(outbox.labelled()).toEqual(new Set(["a"]));
    await settle();
    expect(server.taken).toEqual(["label a", "undo a", "label a"]);
    expect(outbox.holds("a")).toBe(false);
  });

  test("a browser that refuses storage still sends", async () => {
    vi.spyOn(console, "warn").mockReturnValue();
    storage.setItem = () => {
      throw new Error("QuotaExceededError");
    };
    open().put(label("a"));
    await settle();
    expect(server.taken).toEqual(["label a"]);
  });
});
