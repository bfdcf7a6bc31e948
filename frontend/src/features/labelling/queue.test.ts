import { describe, expect, test } from "vitest";
import type { OwnLabel, Query } from "@/shared/api/types";
import { append, EMPTY, labelFirst, remove, undoLast, withHistory } from "./queue";

const query = (id: string) => ({ id }) as Query;
const ids = (queries: readonly Query[]) => queries.map(({ id }) => id);
const none = new Set<string>();

describe("the queue", () => {
  const three = append(EMPTY, [query("a"), query("b"), query("c")], none);

  test("append adds a pair once and leaves out pairs that are already labelled", () => {
    const more = append(three, [query("c"), query("d"), query("e")], new Set(["d"]));
    expect(ids(more.pairs)).toEqual(["a", "b", "c", "e"]);
  });

  test("undo brings the last pair back before the one that followed it", () => {
    const undone = undoLast(labelFirst(labelFirst(three, "left"), "skip"));
    expect(ids(undone.pairs)).toEqual(["b", "c"]);
    expect(undone.past.map(({ choice }) => choice)).toEqual(["left"]);
    expect(ids(undoLast(undone).pairs)).toEqual(["a", "b", "c"]);
  });

  test("undo without a past and a label without a pair change nothing", () => {
    expect(undoLast(three)).toBe(three);
    expect(labelFirst(EMPTY, "left")).toBe(EMPTY);
  });

  test("stored labels become the choices of the sides on which they were seen", () => {
    const stored = (label: number | null, index: number) =>
      ({
        query: { id: `${label} ${index}`, left: { index } },
        label,
        revision: 1,
        updated_at: "",
      }) as OwnLabel;
    const labels = [1, 0.75, 0.5, 0.25, 0, null];
    const choices = (index: number) =>
      withHistory(
        EMPTY,
        labels.map((label) => stored(label, index)),
        false,
      ).past.map(({ choice }) => choice);
    expect(choices(0)).toEqual(["skip", "right", "slightlyRight", "equal", "slightlyLeft", "left"]);
    expect(choices(1)).toEqual(["skip", "left", "slightlyLeft", "equal", "slightlyRight", "right"]);
  });

  test("a removed pair leaves the screen and can no longer be undone", () => {
    const removed = remove(labelFirst(three, "left"), "a");
    expect(undoLast(removed)).toBe(removed);
    expect(ids(remove(three, "a").pairs)).toEqual(["b", "c"]);
  });
});
