import type { PredictedPair } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { formatPercent } from "@/shared/ui/format";
import { atOdds, mostUnsure } from "./ranking";

interface GalleryProps {
  experimentId: string;
  pairs: readonly PredictedPair[];
  /** whether labellers also choose slightly better */
  slight: boolean;
}

/** Pairs on which the model is least certain, and those whose labels it contradicts most. */
export function Gallery({ experimentId, pairs, slight }: GalleryProps) {
  const unsure = mostUnsure(pairs);
  const odds = atOdds(pairs);
  const hasSpread = pairs.some(({ spread }) => spread !== null);
  return (
    <>
      <Pairs
        title="Most unsure"
        note={
          hasSpread
            ? "Pairs on which the models of the ensemble differ most."
            : "Pairs whose probability is closest to 50%: this version has no ensemble."
        }
        empty="The model is sure of every pair."
        experimentId={experimentId}
        pairs={unsure}
        slight={slight}
      />
      <Pairs
        title="Most at odds with the labels"
        note="Labelled pairs for which the model finds the other segment better."
        empty="The model agrees with every label."
        experimentId={experimentId}
        pairs={odds}
        slight={slight}
      />
    </>
  );
}

interface PairsProps extends GalleryProps {
  title: string;
  note: string;
  empty: string;
}

function Pairs({ title, note, empty, experimentId, pairs, slight }: PairsProps) {
  return (
    <section className="card" aria-label={title}>
      <h2>{title}</h2>
      <p className="muted">{pairs.length > 0 ? note : empty}</p>
      <ul className="gallery">
        {pairs.map((pair) => (
          <li key={pair.query_id}>
            <Link to={paths.pair(experimentId, pair.query_id)} className="gallery-pair">
              <span className="gallery-stills">
                {pair.thumbnail_urls.map((url) => (
                  <img key={url} src={url} alt="" loading="lazy" width="100" height="75" />
                ))}
              </span>
              <span>Pair {pair.number}</span>
              <span className="muted">{predictionText(pair)}</span>
              <span className="muted">{labelText(pair, slight)}</span>
            </Link>
          </li>
        ))}
      </ul>
    </section>
  );
}

function predictionText({ probability, spread }: PredictedPair): string {
  const deviation = spread === null ? "" : ` ± ${formatPercent(spread)}`;
  return `P(first is better) ${formatPercent(probability)}${deviation}`;
}

function labelText({ label, trained_on }: PredictedPair, slight: boolean): string {
  if (label === null) return "No label";
  const text =
    label === 1
      ? "First is better"
      : label === 0
        ? "Second is better"
        : label === 0.5
          ? "Equally good"
          : slight
            ? `P(first is better) ${formatPercent(label)}`
            : `First is better for ${formatPercent(label)}`;
  return `Label: ${text}${trained_on ? "" : ", not trained on"}`;
}
