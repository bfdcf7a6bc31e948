import { expect, test } from "vitest";
import { commandOf, LABEL_OF } from "./answers";

const press = (key: string, more: Partial<Parameters<typeof commandOf>[0]> = {}) =>
  commandOf({ key, repeat: false, ctrlKey: false, metaKey: false, altKey: false, ...more });

test("arrows answer, and left is 1 in shown order", () => {
  expect(press("ArrowLeft")).toEqual({ do: "answer", answer: "left" });
  expect(press("ArrowUp")).toEqual({ do: "answer", answer: "equal" });
  expect(LABEL_OF).toEqual({ left: 1, right: 0, equal: 0.5, skip: null });
});

test("a held arrow answers once, a held full stop keeps stepping", () => {
  expect(press("ArrowLeft", { repeat: true })).toBeNull();
  expect(press(".", { repeat: true })).toEqual({ do: "step", direction: 1 });
});

test("browser shortcuts are left to the browser, but undo is undo", () => {
  expect(press("ArrowLeft", { altKey: true })).toBeNull();
  expect(press("1", { ctrlKey: true })).toBeNull();
  expect(press("z", { metaKey: true })).toEqual({ do: "undo" });
});

test("other keys mean nothing", () => {
  expect(press("a")).toBeNull();
  expect(press("Enter")).toBeNull();
});
