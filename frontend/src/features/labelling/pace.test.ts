import { expect, test } from "vitest";
import { Pace } from "./pace";

function paceAfter(answers: number, seconds: number, choice: (index: number) => "equal" | "left"): Pace {
  const pace = new Pace();
  for (let index = 0; index < answers; index++) pace.add(choice(index), seconds);
  return pace;
}

test("a run of equal and very quick answers is hasty until it is dismissed", () => {
  expect(paceAfter(11, 0.76, () => "equal").isHasty).toBe(false);
  const pace = paceAfter(32, 0.76, () => "equal");
  expect(pace.isHasty).toBe(true);
  pace.reset();
  expect(pace.isHasty).toBe(false);
  for (let index = 0; index < 12; index++) pace.add("equal", 0.76);
  expect(pace.isHasty).toBe(true);
});

test("equal answers at a usual pace are not hasty", () => {
  expect(paceAfter(40, 2.5, () => "equal").isHasty).toBe(false);
});

test("quick answers that differ are not hasty", () => {
  expect(paceAfter(40, 0.76, (index) => (index % 3 === 0 ? "equal" : "left")).isHasty).toBe(false);
});
