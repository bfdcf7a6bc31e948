import { expect, test } from "vitest";
import { summaryOf } from "./summary";

test.each([
  ["Run forward.", "Run forward."],
  ["# Goal\nRun **fast**, with `all` legs.\n\nMore.", "Run fast, with all legs."],
  ["# Goal", "Goal"],
  ["![a gait](clip:clp_1)\n\nRun _well_; see [this](https://a.b).", "Run well; see this."],
  ["- one\n- two_words", "one two_words"],
  ["", ""],
])("the summary of %j", (text, summary) => {
  expect(summaryOf(text)).toBe(summary);
});
