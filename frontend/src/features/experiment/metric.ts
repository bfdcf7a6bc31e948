import type { RewardVersion } from "@/shared/api/types";

/** A figure of a reward version; null when it was not measured. */
export function metricOf(version: RewardVersion | undefined, name: string): number | null {
  const value: unknown = version?.metrics[name];
  return typeof value === "number" && Number.isFinite(value) ? value : null;
}
