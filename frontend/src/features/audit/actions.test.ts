import { expect, test } from "vitest";
import { detailText } from "./actions";

test("details are one line", () => {
  expect(detailText({ role: ["labeller", "admin"], disabled: true, days: null })).toBe(
    "role: labeller → admin, disabled: yes",
  );
  expect(detailText({ label_ids: ["a", "b", "c"], access: { all_experiments: false } })).toBe(
    "label ids: 3 items, access: all experiments: no",
  );
});
