import { expect, test } from "vitest";
import { LABELS, labelBody } from "./choices";
import { commandOf } from "./commands";

const press = (key: string, more: Partial<Parameters<typeof commandOf>[0]> = {}) =>
  commandOf({ key, repeat: false, ctrlKey: false, metaKey: false, altKey: false, shiftKey: false, ...more });

test("arrow keys choose, and left is label 1 in the order shown", () => {
  expect(press("ArrowLeft")).toEqual({ type: "choose", choice: "left" });
  expect(press("ArrowUp")).toEqual({ type: "choose", choice: "equal" });
  expect(LABELS).toMatchObject({ left: 1, right: 0, equal: 0.5, skip: null });
});

test("with Shift, an arrow key chooses slightly better", () => {
  expect(press("ArrowLeft", { shiftKey: true })).toEqual({ type: "choose", choice: "slightlyLeft" });
  expect(press("ArrowRight", { shiftKey: true })).toEqual({ type: "choose", choice: "slightlyRight" });
  expect(press("ArrowUp", { shiftKey: true })).toEqual({ type: "choose", choice: "equal" });
  expect(press("?", { shiftKey: true })).toEqual({ type: "showKeys" });
  expect(LABELS).toMatchObject({ slightlyLeft: 0.75, slightlyRight: 0.25 });
});

test("a held arrow key chooses once, a held full stop keeps stepping", () => {
  expect(press("ArrowLeft", { repeat: true })).toBeNull();
  expect(press(".", { repeat: true })).toEqual({ type: "step", direction: 1 });
});

test("browser shortcuts are ignored, except undo", () => {
  expect(press("ArrowLeft", { altKey: true })).toBeNull();
  expect(press("1", { ctrlKey: true })).toBeNull();
  expect(press("z", { metaKey: true })).toEqual({ type: "undo" });
});

test("h shows the labels given so far, and Escape ends a review", () => {
  expect(press("h")).toEqual({ type: "toggleHistory" });
  expect(press("Escape")).toEqual({ type: "closeReview" });
});

test("other keys have no command", () => {
  expect(press("a")).toBeNull();
  expect(press("Tab")).toBeNull();
});

test("a final label replaces whatever its author has given before, and says that it is final", () => {
  expect(labelBody("left", 2, null, null, true, 3)).toMatchObject({ replaces: null, final: true, label: 1 });
  expect(labelBody("left", 2, null, 7, true, 3)).toMatchObject({ replaces: 7, final: true });
  expect(labelBody("right", 2, 4, null, false, 3)).toMatchObject({
    replaces: 0,
    final: null,
    label: 0,
    decisive_agent: 4,
    instructions_revision: 3,
  });
});
