import type { PredictedPair } from "@/shared/api/types";

/** Pairs in each list of the gallery. */
const SHOWN = 12;

/** Without an ensemble, a pair counts as unsure if its probability is closer to a half than this. */
const UNSURE = 0.4;

/** The pairs with the largest spread of the ensemble; without one, those whose probability is closest to a half. */
export function mostUnsure(pairs: readonly PredictedPair[]): PredictedPair[] {
  const uncertainty = ({ spread, probability }: PredictedPair) => spread ?? -Math.abs(probability - 0.5);
  return pairs
    .filter(({ spread, probability }) => spread !== null || Math.abs(probability - 0.5) < UNSURE)
    .sort((a, b) => uncertainty(b) - uncertainty(a))
    .slice(0, SHOWN);
}

/** The labelled pairs that the model predicts wrongly, the most confident errors first. */
export function atOdds(pairs: readonly PredictedPair[]): PredictedPair[] {
  const distance = ({ label, probability }: PredictedPair) =>
    label === null ? 0 : Math.abs(probability - label);
  return pairs
    .filter(({ label, probability }) => label !== null && (label - 0.5) * (probability - 0.5) < 0)
    .sort((a, b) => distance(b) - distance(a))
    .slice(0, SHOWN);
}
