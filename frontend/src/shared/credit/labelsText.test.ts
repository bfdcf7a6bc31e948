import { expect, test } from "vitest";
import { labelsText } from "./labelsText";

test("one label is said in words, on the sides that the user sees", () => {
  expect(labelsText([1], 0)).toBe("Label: left is better");
  expect(labelsText([1], 1)).toBe("Label: right is better");
  expect(labelsText([0.25], 1)).toBe("Label: left is slightly better");
  expect(labelsText([0.5], 1)).toBe("Label: equally good");
  expect(labelsText([], 0)).toBe("No label");
});

test("opposite labels are counted, not averaged", () => {
  expect(labelsText([1, 0], 0)).toBe("Labels: 1 left, 1 right");
  expect(labelsText([0, 0.75, 0, 0.5], 1)).toBe("Labels: 2 left, 1 equal, 1 slightly right");
});
