import { expect, test } from "vitest";
import type { Worker } from "@/shared/api/types";
import { formatValue, plural, workersTrouble } from "./words";

const worker = (role: string, state: string, age = 1): Worker => ({
  id: `${role}-0`,
  role,
  state,
  detail: "",
  restarts: 0,
  heartbeat_age_seconds: age,
});

test("workers that work cause no notice", () => {
  expect(workersTrouble([worker("policy", "working"), worker("render", "idle")])).toBeNull();
});

test("a role with one worker left is not standing still", () => {
  expect(workersTrouble([worker("render", "stopped"), worker("render", "working")])).toBeNull();
});

test("a worker that is restarted, or silent, is named by what stands still", () => {
  expect(workersTrouble([worker("policy", "backing_off")])).toBe(
    "The policy stands still: a worker stopped and is being restarted. No label is lost.",
  );
  expect(workersTrouble([worker("render", "working", 90), worker("reward", "stopped")])).toBe(
    "New clips and the reward model stand still: a worker stopped. No label is lost.",
  );
});

test("numbers keep the digits that move", () => {
  expect([0.8412, 12.34, 123.4, 45_000].map(formatValue)).toEqual(["0.841", "12.3", "123", "45K"]);
  expect(plural(1, "label")).toBe("1 label");
  expect(plural(1200, "label")).toBe("1,200 labels");
});
