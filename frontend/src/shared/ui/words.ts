import type { Experiment, Worker } from "@/shared/api/types";

const count = new Intl.NumberFormat("en-GB");
const compact = new Intl.NumberFormat("en-US", { notation: "compact", maximumFractionDigits: 1 });

export const formatCount = (value: number): string => count.format(value);
export const formatCompact = (value: number): string => compact.format(value);
export const formatPercent = (share: number): string => `${Math.round(100 * share)}%`;

/** A number of a curve: enough digits to see it move. */
export function formatValue(value: number): string {
  const size = Math.abs(value);
  if (size >= 10_000) return compact.format(value);
  return value.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : 3);
}

export function plural(amount: number, one: string, many = `${one}s`): string {
  return `${formatCount(amount)} ${amount === 1 ? one : many}`;
}

const PHASES: Readonly<Record<Experiment["phase"], string>> = {
  queued: "Waiting to start",
  collecting: "Collecting clips",
  waiting_for_labels: "Waiting for labels",
  training: "Training",
  evaluating: "Measuring",
  done: "Done",
};

const STATUSES: Readonly<Record<Experiment["status"], string>> = {
  running: "Running",
  paused: "Paused",
  cancelled: "Cancelled",
  finished: "Finished",
  failed: "Failed",
};

export const statusWords = (experiment: Experiment): string => STATUSES[experiment.status];

/** Whether it ended: nothing is asked of anyone any more. */
export function isOver({ status }: Experiment): boolean {
  return status === "cancelled" || status === "finished" || status === "failed";
}

/** What the policy is doing, in two or three words. */
export function phaseWords(experiment: Experiment): string {
  return experiment.status === "running" ? PHASES[experiment.phase] : STATUSES[experiment.status];
}

/** A worker that has not been heard of for this long is taken for stopped. */
const SILENT_SECONDS = 30;

export function isDown(worker: Worker): boolean {
  return (
    worker.state === "stopped" ||
    worker.state === "backing_off" ||
    worker.heartbeat_age_seconds > SILENT_SECONDS
  );
}

const WORK: Readonly<Record<string, string>> = {
  render: "New clips",
  reward: "The reward model",
  policy: "The policy",
};

/** One sentence on what stands still because a worker is down; null when all of them work. */
export function workersTrouble(workers: readonly Worker[]): string | null {
  const down = workers.filter(isDown);
  const roles = [...new Set(down.map(({ role }) => role))].filter((role) =>
    workers.every((worker) => worker.role !== role || isDown(worker)),
  );
  if (roles.length === 0) return null;
  const [first = "", ...others] = roles.map((role) => WORK[role] ?? role);
  const what = [first, ...others.map((word) => word.toLowerCase())].join(" and ");
  const restarting = down.some(({ state }) => state === "backing_off");
  return `${what} ${roles.length > 1 ? "stand" : "stands"} still: a worker stopped${
    restarting ? " and is being restarted" : ""
  }. No label is lost.`;
}
