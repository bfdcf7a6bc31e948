import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { Outbox } from "@/shared/outbox/outbox";
import { MemoryStorage, Server } from "./fakeServer";
import { LabellingSession } from "./session";

let server: Server;

const open = () => {
  const outbox = new Outbox("usr_1", new MemoryStorage(), server.send);
  const options = { experimentId: "exp_1", tab: "tab", decides: false, rules: 1 };
  return new LabellingSession({ ...options, server, outbox });
};
const settle = (ms = 300) => vi.advanceTimersByTimeAsync(ms);
const onScreen = (session: LabellingSession) => session.view().current?.id ?? null;

beforeEach(() => {
  vi.useFakeTimers();
  server = new Server("abcdef");
});
afterEach(() => {
  vi.useRealTimers();
});

describe("the history of a session", () => {
  test("a new tab can undo the labels of another one", async () => {
    server.labelElsewhere("a", 1);
    server.labelElsewhere("b", null);
    const session = open();
    await settle();
    expect([onScreen(session), session.view().labelCount]).toEqual(["c", 1]);
    session.undo();
    await settle();
    session.undo();
    await settle();
    expect([onScreen(session), session.view().labelCount, server.labels.size]).toEqual(["a", 0, 0]);
  });

  test("a pair of the history is shown again and its label changed", async () => {
    const session = open();
    await settle();
    for (const choice of ["left", "equal"] as const) {
      session.choose(choice, 2);
      await settle();
    }
    session.review("a");
    expect([onScreen(session), session.view().reviewed?.choice]).toEqual(["a", "left"]);
    session.choose("left", 2);
    expect([onScreen(session), server.revision]).toEqual(["c", 2]);
    session.review("a");
    session.choose("skip", 2);
    await settle();
    expect([onScreen(session), session.view().labelCount, server.labels.get("a")]).toEqual(["c", 1, null]);
    expect(session.view().history.map(({ query: { id } }) => id)).toEqual(["b", "a"]);
    // While the server is down, a label that was changed twice is undone once it is back.
    server.down = true;
    session.review("b");
    session.choose("right", 2);
    await settle();
    session.undo();
    expect(onScreen(session)).toBe("b");
    server.down = false;
    await settle(10_000);
    expect([...server.labels]).toEqual([["a", null]]);
  });

  test("a pair that another tab has labelled is not overwritten", async () => {
    const session = open();
    await settle();
    server.labelElsewhere("a", 0);
    session.choose("left", 2);
    await settle();
    expect(session.view().notice).toContain("another tab");
    expect([server.labels.get("a"), session.view().labelCount]).toEqual([0, 1]);
    expect(session.view().history.map(({ choice }) => choice)).toEqual(["right"]);
  });

  test("older labels are loaded on request", async () => {
    for (let number = 0; number < 30; number++) server.labelElsewhere(`old ${number}`, 1);
    const session = open();
    await settle();
    expect([session.view().history.length, session.view().hasOlder]).toEqual([24, true]);
    session.loadOlder();
    await settle();
    expect([session.view().history.length, session.view().hasOlder]).toEqual([30, false]);
    expect(session.view().history[0]?.query.id).toBe("old 0");
  });
});
