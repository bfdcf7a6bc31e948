import type { LabellerQuality } from "@/shared/api/types";
import { formatPercent } from "@/shared/ui/format";

export type Flag = LabellerQuality["flags"][number];

/** What is conspicuous about a labeller, with the number that shows it. The server judges by 95% intervals. */
export function flagText(flag: Flag, labeller: LabellerQuality): string {
  const { seconds, left, equal, gold, consistency, agreement } = labeller;
  const share = (of: typeof left) => (of ? formatPercent(of.count / of.of) : "–");
  switch (flag) {
    case "fast":
      return `Half of the answers take less than ${seconds?.value.toFixed(1) ?? "1"} s, too short to compare two clips.`;
    case "left":
      return `Prefers the left clip in ${share(left)} of cases, although sides are random.`;
    case "right":
      return `Prefers the left clip in only ${share(left)} of cases, although sides are random.`;
    case "equal":
      return `Says “equally good” in ${share(equal)} of cases, more often than others.`;
    case "gold":
      return `Right on ${share(gold)} of the pairs whose answer is known.`;
    case "inconsistent":
      return `Gives the same answer to ${share(consistency)} of repeated pairs.`;
    case "opposite":
      return "Mostly prefers the other clip than everybody else: perhaps the keys or the task are misunderstood.";
    case "disagrees":
      return `Agrees with others on ${share(agreement)} of shared labels, less than they do among themselves.`;
  }
}
