import { expect, test } from "vitest";
import type { Task } from "@/shared/api/types";
import { agentAt, agentsAt } from "./hoveredAgent";

const task = {
  agent_colours: ["#E69F00", "#0072B2", "#E69F00"],
  agent_names: ["hip", "knee", "tail"],
} as Task;

test("a limb is recognised by its colour, lit or shaded", () => {
  expect(agentAt([0, 114, 178], task)).toBe("knee");
  expect(agentAt([6, 76, 112], task)).toBe("knee");
});

test("agents of the same colour are named together", () => {
  expect(agentAt([230, 159, 0], task)).toBe("hip; with stripes tail");
  expect(agentsAt([230, 159, 0], task)).toEqual([0, 2]);
});

test("the floor, the backdrop and the torso belong to no agent", () => {
  for (const pixel of [
    [72, 83, 95],
    [37, 44, 54],
    [174, 180, 187],
  ] as const)
    expect(agentAt(pixel, task)).toBeNull();
});
