/** P(left preferred) -> the only label of a pair, and its name in a count. */
const NAMES = new Map([
  [1, ["left is better", "left"]],
  [0.75, ["left is slightly better", "slightly left"]],
  [0.5, ["equally good", "equal"]],
  [0.25, ["right is slightly better", "slightly right"]],
  [0, ["right is better", "right"]],
]);

/**
 * What the labels of a pair say, such as "Labels: 2 left, 1 right". Their mean would call opposite labels equally good.
 *
 * @param labels P(segment 0 preferred) of each label.
 * @param leftSegment the segment on the left.
 */
export function labelsText(labels: readonly number[], leftSegment: number): string {
  const ofLeft = labels.map((label) => (leftSegment === 0 ? label : 1 - label));
  const [only] = ofLeft;
  if (only === undefined) return "No label";
  if (ofLeft.length === 1) return `Label: ${NAMES.get(only)?.[0] ?? unnamed(only)}`;
  const values = [...new Set(ofLeft)].sort((a, b) => b - a);
  const counts = values.map(
    (value) =>
      `${ofLeft.filter((label) => label === value).length} ${NAMES.get(value)?.[1] ?? unnamed(value)}`,
  );
  return `Labels: ${counts.join(", ")}`;
}

/** An imported label may have any value. */
const unnamed = (value: number): string => `P(left is better) ${value}`;
