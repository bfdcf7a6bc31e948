import type { NewExperiment, Task } from "@/shared/api/types";

/** The form as typed: text in every field, whatever it means. */
export type Form = Record<FieldName, string>;

export type FieldName = keyof typeof DEFAULTS;

export const DEFAULTS = {
  name: "",
  task: "",
  instructions: "",
  total_steps: "1000000",
  label_budget: "500",
  initial_labels: "100",
  labels_per_version: "50",
  segment_steps: "50",
  query_selection: "uniform",
  label_schedule: "power",
  pacing: "wait",
  reward_source: "preferences",
  reward_preset: "small",
  credit: "shared",
  seed: "0",
};

export const NUMBERS = [
  "total_steps",
  "label_budget",
  "initial_labels",
  "labels_per_version",
  "segment_steps",
  "seed",
] as const;

/** The request that the form stands for. A number left empty takes the server's default. */
export function requestOf(form: Form): NewExperiment {
  const numbers = Object.fromEntries(
    NUMBERS.filter((name) => form[name].trim() !== "").map((name) => [name, Number(form[name])]),
  );
  return {
    ...numbers,
    name: form.name.trim(),
    task: form.task,
    instructions: form.instructions.trim() || null,
    query_selection: form.query_selection,
    label_schedule: form.label_schedule,
    pacing: form.pacing === "free" ? "free" : "wait",
    reward_source: form.reward_source === "true" ? "true" : "preferences",
    reward_preset: form.reward_preset,
    credit: form.credit === "individual" ? "individual" : "shared",
  } as NewExperiment;
}

/** The field that a refusal speaks of, so that it can be shown beside it: the first one that it names. */
export function fieldOf(message: string): FieldName | null {
  const names = Object.keys(DEFAULTS) as FieldName[];
  const places = names
    .map((name) => ({ name, at: message.search(new RegExp(`\\b${name}\\b`)) }))
    .filter(({ at, name }) => at >= 0 && name !== "task" && name !== "name");
  places.sort((a, b) => a.at - b.at);
  return places[0]?.name ?? null;
}

/** How long a clip of this many steps lasts, in words. */
export function clipWords(steps: string, task: Task | undefined): string {
  const seconds = Number(steps) * (task?.step_seconds ?? Number.NaN);
  return Number.isFinite(seconds) && seconds > 0 ? `a clip of ${seconds.toFixed(1)} s` : "";
}
