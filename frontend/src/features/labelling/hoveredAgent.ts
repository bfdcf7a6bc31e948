import type { Task } from "@/shared/api/types";

/** Light and shade scale a limb's colour by a factor within these limits. */
const SHADE = { least: 0.5, most: 1.1 };
/** Largest difference of a channel from the shaded colour: video compression changes colours a little. */
const TOLERANCE = 22;

type Colour = readonly [number, number, number];

/** The agents whose limbs have this colour in a clip; none for the floor and for parts that no agent moves. */
export function agentsAt(pixel: Colour, { agent_colours }: Pick<Task, "agent_colours">): number[] {
  const distances = agent_colours.map((colour) => distance(pixel, parse(colour)));
  const nearest = Math.min(...distances);
  if (nearest > TOLERANCE) return [];
  return distances.flatMap((each, agent) => (each === nearest ? [agent] : []));
}

/** The name of the agent whose limb has this colour in a clip; null if there is none. */
export function agentAt(pixel: Colour, task: Task): string | null {
  const names = agentsAt(pixel, task).map((agent) => task.agent_names[agent]);
  // The limbs of agents with a repeated colour have stripes.
  return names.length > 1 ? `${names[0]}; with stripes ${names.slice(1).join(", ")}` : (names[0] ?? null);
}

function distance(pixel: Colour, colour: Colour): number {
  const dot = (one: Colour, other: Colour) => one[0] * other[0] + one[1] * other[1] + one[2] * other[2];
  const shade = Math.min(SHADE.most, Math.max(SHADE.least, dot(pixel, colour) / dot(colour, colour)));
  return Math.max(...colour.map((channel, index) => Math.abs((pixel[index] ?? 0) - shade * channel)));
}

function parse(colour: string): Colour {
  const value = Number.parseInt(colour.slice(1), 16);
  return [value >> 16, (value >> 8) & 255, value & 255];
}
