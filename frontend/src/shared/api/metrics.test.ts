import { describe, expect, test } from "vitest";
import { mergeMetrics, pointsOf } from "./metrics";

const series = (name: string, ...points: [number, number][]) => ({
  name,
  points: points.map(([step, value]) => ({ step, value })),
});

describe("mergeMetrics", () => {
  test("appends new points and new series", () => {
    const old = { series: [series("labels", [0, 1], [10, 5])] };
    const merged = mergeMetrics(old, {
      series: [series("labels", [20, 9]), series("true_return", [20, -3])],
    });
    expect(pointsOf(merged, "labels")?.map((point) => point.value)).toEqual([1, 5, 9]);
    expect(pointsOf(merged, "true_return")?.map((point) => point.step)).toEqual([20]);
  });

  test("a new point replaces the old one of the same step, and steps stay sorted", () => {
    const old = { series: [series("labels", [0, 1], [20, 5])] };
    const merged = mergeMetrics(old, { series: [series("labels", [10, 3], [20, 6])] });
    expect(pointsOf(merged, "labels")).toEqual([
      { step: 0, value: 1 },
      { step: 10, value: 3 },
      { step: 20, value: 6 },
    ]);
  });

  test("an unknown series is null, not empty", () => {
    expect(pointsOf({ series: [] }, "true_return")).toBeNull();
  });
});
