import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { ApiError, Unreachable } from "@/shared/api/errors";
import type { Queries, Query } from "@/shared/api/types";
import { type Operation, Outbox } from "@/shared/outbox/outbox";
import { LabellingSession } from "./session";

const query = (id: string) => ({ id, lease_seconds: 60 }) as Query;

/** A server with pairs a, b, c, ...: it offers what is neither labelled nor lost, the lowest first. */
class Server {
  readonly labels = new Map<string, number | null>();
  readonly released: string[] = [];
  reason: Queries["reason"] = "";
  down = false;
  lost = new Set<string>();
  undos = 0;

  readonly ids: string[];

  constructor(ids: string) {
    this.ids = [...ids];
  }

  next = async (count: number): Promise<Queries> => {
    await Promise.resolve();
    if (this.down) throw new Unreachable(null);
    const free = this.ids.filter((id) => !this.labels.has(id) && !this.lost.has(id));
    return { items: free.slice(0, count).map(query), reason: this.reason };
  };
  heartbeat = async (id: string) => {
    if (this.lost.has(id)) throw new ApiError(410, "lease_lost", "You hold no lease.");
  };
  release = (id: string) => void this.released.push(id);
  send = async (operation: Operation) => {
    await Promise.resolve();
    if (this.down) throw new Unreachable(null);
    if (this.lost.has(operation.queryId)) throw new ApiError(410, "lease_lost", "You hold no lease.");
    if (operation.kind === "label") this.labels.set(operation.queryId, operation.body.label);
    else {
      this.undos += 1;
      this.labels.delete(operation.queryId);
    }
  };
}

class MemoryStorage {
  readonly #items = new Map<string, string>();
  get length() {
    return this.#items.size;
  }
  key = (index: number) => [...this.#items.keys()][index] ?? null;
  getItem = (key: string) => this.#items.get(key) ?? null;
  setItem = (key: string, value: string) => void this.#items.set(key, value);
  removeItem = (key: string) => void this.#items.delete(key);
}

let server: Server;
let local: MemoryStorage;
let tab: MemoryStorage;

const open = () => {
  const outbox = new Outbox("usr_1", local, server.send);
  return new LabellingSession({ experimentId: "exp_1", server, outbox, storage: tab, storageKey: "session" });
};
const settle = (ms = 300) => vi.advanceTimersByTimeAsync(ms);
const onScreen = (session: LabellingSession) => session.view().current?.id ?? null;

beforeEach(() => {
  vi.useFakeTimers();
  server = new Server("abcdef");
  local = new MemoryStorage();
  tab = new MemoryStorage();
});
afterEach(() => {
  vi.useRealTimers();
});

describe("LabellingSession", () => {
  test("holds one pair on screen and two ahead", async () => {
    const session = open();
    await settle();
    expect(onScreen(session)).toBe("a");
    expect(session.view().upcoming.map(({ id }) => id)).toEqual(["b", "c"]);
  });

  test("an answer is outlined, sent, and followed by the next pair", async () => {
    const session = open();
    await settle();
    session.answer("left", 2.5);
    expect([onScreen(session), session.view().flash]).toEqual(["a", "left"]);
    await settle();
    expect([onScreen(session), session.view().flash, session.view().labelled]).toEqual(["b", null, 1]);
    expect(server.labels).toEqual(new Map([["a", 1]]));
    expect(session.view().upcoming.map(({ id }) => id)).toEqual(["c", "d"]);
  });

  test("a second key while the answer is outlined says nothing about the next pair", async () => {
    const session = open();
    await settle();
    session.answer("left", 2);
    session.answer("right", 2);
    await settle();
    expect(server.labels).toEqual(new Map([["a", 1]]));
    expect(onScreen(session)).toBe("b");
  });

  test("labelling goes on while the server is down, with the pairs at hand", async () => {
    const session = open();
    await settle();
    server.down = true;
    for (const answer of ["left", "right", "equal"] as const) {
      session.answer(answer, 2);
      await settle();
    }
    expect(onScreen(session)).toBeNull();
    expect(session.view().trouble).toContain("does not answer");
    server.down = false;
    await settle(10_000);
    expect(server.labels).toEqual(
      new Map([
        ["a", 1],
        ["b", 0],
        ["c", 0.5],
      ]),
    );
    expect(onScreen(session)).toBe("d");
  });

  test("undo brings the pair back and takes the label away", async () => {
    const session = open();
    await settle();
    session.answer("left", 2);
    await settle();
    session.undo();
    expect([onScreen(session), session.view().labelled]).toEqual(["a", 0]);
    await settle();
    expect(server.labels.size).toBe(0);
    session.answer("skip", 2);
    await settle();
    expect(server.labels).toEqual(new Map([["a", null]]));
    expect([onScreen(session), session.view().labelled]).toEqual(["b", 0]);
  });

  test("undo while the answer is still outlined works too", async () => {
    const session = open();
    await settle();
    session.answer("left", 2);
    session.undo();
    await settle();
    expect([onScreen(session), session.view().flash, session.view().labelled]).toEqual(["a", null, 0]);
    expect(server.labels.size).toBe(0);
  });

  test("after a reload the last label can still be undone, and the count goes on", async () => {
    const before = open();
    await settle();
    before.answer("left", 2);
    await settle();
    before.dispose();
    const session = open();
    await settle();
    expect([onScreen(session), session.view().labelled]).toEqual(["b", 1]);
    session.undo();
    await settle();
    expect([onScreen(session), server.undos]).toEqual(["a", 1]);
  });

  test("a label that was not taken is said, and counts no more", async () => {
    const session = open();
    await settle();
    server.lost.add("a");
    session.answer("left", 2);
    await settle();
    expect(session.view().notice).toContain("A label was not taken");
    expect([onScreen(session), session.view().labelled]).toEqual(["b", 0]);
    session.undo();
    expect(session.view().notice).toBe("There is nothing to undo.");
  });

  test("a pair that went to someone else leaves the screen", async () => {
    const session = open();
    await settle();
    server.lost.add("a");
    await settle(21_000);
    expect(onScreen(session)).toBe("b");
    expect(session.view().notice).toContain("someone else");
  });

  test("a heartbeat that crosses the label on its way neither drops the pair nor the count", async () => {
    server.heartbeat = async (id) => {
      await new Promise((resolve) => setTimeout(resolve, 100));
      if (server.labels.has(id)) throw new ApiError(409, "query_closed", "It has its label.");
    };
    const session = open();
    await settle(20_000 - 50); // the heartbeat leaves in 50 ms and is answered 100 ms later, while the answer is outlined
    await settle(100);
    session.answer("left", 2);
    await settle();
    expect([onScreen(session), session.view().labelled, session.view().notice]).toEqual(["b", 1, null]);
  });

  test("someone who went away gives the pairs up, and takes them up again on return", async () => {
    const session = open();
    const beats = vi.spyOn(server, "heartbeat");
    await settle(601_000);
    beats.mockClear();
    await settle(120_000);
    expect(beats).not.toHaveBeenCalled();
    session.wake();
    await settle();
    expect(beats).toHaveBeenCalledTimes(3);
  });

  test("without pairs it says why, and goes on by itself", async () => {
    server = new Server("");
    server.reason = "rendering";
    const session = open();
    await settle();
    expect([onScreen(session), session.view().reason]).toEqual([null, "rendering"]);
    server.ids.push("a");
    await settle(1_500);
    expect(onScreen(session)).toBe("a");
  });

  test("leaving gives back the pairs that were not labelled", async () => {
    const session = open();
    await settle();
    session.answer("left", 2);
    session.dispose();
    expect(server.released).toEqual(["b", "c"]);
    await settle(5_000);
    expect(server.labels).toEqual(new Map([["a", 1]]));
  });
});
