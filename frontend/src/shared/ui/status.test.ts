import { expect, test } from "vitest";
import type { Worker } from "@/shared/api/types";
import { workerWarning } from "./status";

const worker = (role: string, state: string, age = 1): Worker => ({
  id: `${role}-0`,
  role,
  state,
  detail: "",
  restarts: 0,
  heartbeat_age_seconds: age,
});

test("running workers cause no warning", () => {
  expect(workerWarning([worker("policy", "working"), worker("render", "idle")])).toBeNull();
});

test("a role with one running worker causes no warning", () => {
  expect(workerWarning([worker("render", "stopped"), worker("render", "working")])).toBeNull();
});

test("the warning names the work that has stopped", () => {
  expect(workerWarning([worker("policy", "backing_off")])).toBe(
    "Policy training has stopped because a worker is down. It is being restarted. No labels are lost.",
  );
  expect(workerWarning([worker("render", "working", 90), worker("reward", "stopped")])).toBe(
    "Clip rendering and reward training have stopped because a worker is down. No labels are lost.",
  );
});
