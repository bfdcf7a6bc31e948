import { expect, test } from "vitest";
import { clipWords, DEFAULTS, fieldOf, requestOf } from "./fields";

test("the request carries numbers as numbers and leaves the empty ones to the server", () => {
  const request = requestOf({
    ...DEFAULTS,
    name: " run ",
    task: "HalfCheetah-6x1",
    total_steps: "20000",
    seed: "",
  });
  expect(request).toMatchObject({
    name: "run",
    task: "HalfCheetah-6x1",
    total_steps: 20000,
    instructions: null,
    query_selection: "uniform",
    label_schedule: "power",
  });
  expect(request).not.toHaveProperty("seed");
});

test("a refusal is shown at the field that it names first", () => {
  expect(fieldOf("initial_labels is 600; it must be from 2 to label_budget (500).")).toBe("initial_labels");
  expect(fieldOf("segment_steps is 5000, but an episode of HalfCheetah-6x1 lasts 1000 steps.")).toBe(
    "segment_steps",
  );
  expect(fieldOf("There is an experiment of this name already.")).toBeNull();
});

test("the length of a clip is said in seconds, or not at all", () => {
  const task = { step_seconds: 0.05 } as Parameters<typeof clipWords>[1];
  expect(clipWords("50", task)).toBe("a clip of 2.5 s");
  expect(clipWords("", task)).toBe("");
  expect(clipWords("50", undefined)).toBe("");
});
