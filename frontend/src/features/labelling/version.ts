import type { RewardVersion } from "@/shared/api/types";

/** Share of held-out labels that a version agrees with; null when it was not measured. */
export function holdoutAccuracy(version: RewardVersion | undefined): number | null {
  const value: unknown = version?.metrics.holdout_accuracy;
  return typeof value === "number" && Number.isFinite(value) ? value : null;
}
