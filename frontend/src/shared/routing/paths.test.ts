import { expect, test } from "vitest";
import { paths, routeOf } from "./paths";

test("routeOf inverts paths", () => {
  expect(routeOf(paths.experiments())).toEqual({ page: "experiments" });
  expect(routeOf(paths.newExperiment())).toEqual({ page: "new-experiment" });
  expect(routeOf(paths.experiment("exp_1"))).toEqual({ page: "experiment", id: "exp_1" });
  expect(routeOf(paths.compare(["exp_1", "exp_2"]))).toEqual({ page: "compare", ids: ["exp_1", "exp_2"] });
  expect(routeOf(paths.label("exp_1"))).toEqual({ page: "label", id: "exp_1" });
  expect(routeOf(paths.labels("exp_1"))).toEqual({ page: "labels", id: "exp_1" });
});

test.each([
  "/nowhere",
  "/experiments/a/b",
  "/experiments/a/label/x",
  "/experiments/new/x",
  "/experiments/100%",
])("%s has no page", (path) => {
  expect(routeOf(path)).toEqual({ page: "missing" });
});
