import { expect, test } from "vitest";
import type { PredictedPair } from "@/shared/api/types";
import { atOdds, mostUnsure } from "./ranking";

const pair = (number: number, fields: Partial<PredictedPair>): PredictedPair => ({
  query_id: `qry_${number}`,
  number,
  probability: 0.5,
  spread: null,
  label: null,
  labels: [],
  trained_on: false,
  thumbnail_urls: [],
  left_segment: 0,
  ...fields,
});
const numbers = (pairs: PredictedPair[]) => pairs.map(({ number }) => number);

test("without an ensemble, probabilities near a half are the most unsure", () => {
  const pairs = [0.8, 0.55, 0.15, 0.01].map((probability, number) => pair(number, { probability }));
  expect(numbers(mostUnsure(pairs))).toEqual([1, 0, 2]);
});

test("with an ensemble, its spread decides", () => {
  const pairs = [0.01, 0.3, 0.1].map((spread, number) => pair(number, { spread }));
  expect(numbers(mostUnsure(pairs))).toEqual([1, 2, 0]);
});

test("pairs at odds are those predicted wrongly, the most confident first", () => {
  const pairs = [
    pair(0, { probability: 0.6, label: 0 }),
    pair(1, { probability: 0.9, label: 1 }),
    pair(2, { probability: 0.05, label: 1 }),
    pair(3, { probability: 0.9, label: 0.5 }),
    pair(4, { probability: 0.9 }),
  ];
  expect(numbers(atOdds(pairs))).toEqual([2, 0]);
});
