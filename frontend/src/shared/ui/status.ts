import type { Experiment, Worker } from "@/shared/api/types";

const PHASES: Readonly<Record<Experiment["phase"], string>> = {
  queued: "Queued",
  collecting: "Collecting clips",
  waiting_for_labels: "Waiting for labels",
  training: "Training",
  evaluating: "Evaluating",
  done: "Done",
};

const STATUSES: Readonly<Record<Experiment["status"], string>> = {
  running: "Running",
  paused: "Paused",
  cancelled: "Cancelled",
  finished: "Finished",
  failed: "Failed",
};

/** Whether the experiment has ended, so that it needs no more labels. */
export function isOver({ status }: Experiment): boolean {
  return status === "cancelled" || status === "finished" || status === "failed";
}

/** The phase of a running experiment, or the status of any other, for display. */
export function phaseText(experiment: Experiment): string {
  return experiment.status === "running" ? PHASES[experiment.phase] : STATUSES[experiment.status];
}

/** A worker without a heartbeat for this long counts as stopped. */
const HEARTBEAT_TIMEOUT_SECONDS = 30;

export function isDown(worker: Worker): boolean {
  return (
    worker.state === "stopped" ||
    worker.state === "backing_off" ||
    worker.heartbeat_age_seconds > HEARTBEAT_TIMEOUT_SECONDS
  );
}

const WORK: Readonly<Record<string, string>> = {
  render: "Clip rendering",
  reward: "Reward training",
  policy: "Policy training",
};

/** One sentence about the roles that have no running worker; null when every role has one. */
export function workerWarning(workers: readonly Worker[]): string | null {
  const down = workers.filter(isDown);
  const roles = [...new Set(down.map(({ role }) => role))].filter((role) =>
    workers.every((worker) => worker.role !== role || isDown(worker)),
  );
  if (roles.length === 0) return null;
  const [first = "", ...others] = roles.map((role) => WORK[role] ?? role);
  const work = [first, ...others.map((name) => name.toLowerCase())].join(" and ");
  const restarting = down.some(({ state }) => state === "backing_off");
  return `${work} ${roles.length > 1 ? "have" : "has"} stopped because a worker is down.${
    restarting ? " It is being restarted." : ""
  } No labels are lost.`;
}
