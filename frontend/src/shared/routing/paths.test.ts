import { expect, test } from "vitest";
import { paths, routeOf } from "./paths";

test("routeOf inverts paths", () => {
  expect(routeOf(paths.experiments())).toEqual({ page: "experiments" });
  expect(routeOf(paths.newExperiment())).toEqual({ page: "new-experiment" });
  expect(routeOf(paths.experiment("exp_1"))).toEqual({ page: "experiment", id: "exp_1" });
  expect(routeOf(paths.compare(["exp_1", "exp_2"]))).toEqual({ page: "compare", ids: ["exp_1", "exp_2"] });
  expect(routeOf(paths.label("exp_1"))).toEqual({ page: "label", id: "exp_1" });
  expect(routeOf(paths.apiDocs())).toEqual({ page: "api-docs" });
  expect(routeOf(paths.audit())).toEqual({ page: "audit" });
  expect(routeOf(paths.account())).toEqual({ page: "account" });
  expect(routeOf(paths.people())).toEqual({ page: "people" });
  expect(routeOf(paths.labels("exp_1"))).toEqual({ page: "labels", id: "exp_1" });
  expect(routeOf(paths.quality("exp_1"))).toEqual({ page: "quality", id: "exp_1" });
  expect(routeOf(paths.decide("exp_1"))).toEqual({ page: "decide", id: "exp_1" });
  expect(routeOf(paths.reward("exp_1"))).toEqual({ page: "reward", id: "exp_1" });
  expect(routeOf(paths.policies("exp_1"))).toEqual({ page: "policies", id: "exp_1" });
  expect(routeOf(paths.pair("exp_1", "qry_1"))).toEqual({ page: "pair", id: "exp_1", query: "qry_1" });
});

test("a sign-in link holds its token", () => {
  expect(paths.signInLinkOf("/sign-in/a-b_c")).toBe("a-b_c");
  expect(paths.signInLinkOf("/sign-in/")).toBeNull();
});

test("the link of an invitation holds its token", () => {
  expect(paths.invitationOf("/join/a-b_c")).toBe("a-b_c");
  expect(paths.invitationOf("/join/")).toBeNull();
  expect(paths.invitationOf("/experiments/join/a")).toBeNull();
});

test.each([
  "/nowhere",
  "/experiments/a/b",
  "/experiments/a/label/x",
  "/experiments/new/x",
  "/experiments/a/pairs",
  "/experiments/a/reward/x",
  "/experiments/100%",
])("%s has no page", (path) => {
  expect(routeOf(path)).toEqual({ page: "missing" });
});
