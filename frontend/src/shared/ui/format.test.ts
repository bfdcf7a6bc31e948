import { expect, test } from "vitest";
import { formatValue, plural } from "./format";

test("values are formatted with about three significant digits", () => {
  expect([0.8412, 12.34, 123.4, 45_000].map(formatValue)).toEqual(["0.841", "12.3", "123", "45K"]);
  expect(plural(1, "label")).toBe("1 label");
  expect(plural(1200, "label")).toBe("1,200 labels");
});
