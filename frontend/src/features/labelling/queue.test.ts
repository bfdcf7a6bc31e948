import { describe, expect, test } from "vitest";
import type { Query } from "@/shared/api/types";
import { answered, dropped, EMPTY, offered, undone } from "./queue";

const query = (id: string) => ({ id }) as Query;
const ids = (queries: readonly Query[]) => queries.map(({ id }) => id);
const none = new Set<string>();

describe("the queue", () => {
  const three = offered(EMPTY, [query("a"), query("b"), query("c")], none);

  test("takes a pair once and leaves out what is answered here already", () => {
    const more = offered(three, [query("c"), query("d"), query("e")], new Set(["d"]));
    expect(ids(more.pairs)).toEqual(["a", "b", "c", "e"]);
  });

  test("undo brings the last pair back before the one that had followed it", () => {
    const back = undone(answered(answered(three, "left"), "skip"));
    expect(ids(back.pairs)).toEqual(["b", "c"]);
    expect(back.past.map(({ answer }) => answer)).toEqual(["left"]);
    expect(ids(undone(back).pairs)).toEqual(["a", "b", "c"]);
  });

  test("nothing to undo, nothing to answer: nothing changes", () => {
    expect(undone(three)).toBe(three);
    expect(answered(EMPTY, "left")).toBe(EMPTY);
  });

  test("a lost pair leaves the screen and can no longer be undone", () => {
    const lost = dropped(answered(three, "left"), "a");
    expect(undone(lost)).toBe(lost);
    expect(ids(dropped(three, "a").pairs)).toEqual(["b", "c"]);
  });
});
