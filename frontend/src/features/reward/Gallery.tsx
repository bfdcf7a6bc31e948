import type { PredictedPair } from "@/shared/api/types";
import { labelsText } from "@/shared/credit/labelsText";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { formatPercent } from "@/shared/ui/format";
import { atOdds, mostUnsure } from "./ranking";

interface GalleryProps {
  experimentId: string;
  pairs: readonly PredictedPair[];
}

/** Pairs on which the model is least certain, and those whose labels it contradicts most. */
export function Gallery({ experimentId, pairs }: GalleryProps) {
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
      />
      <Pairs
        title="Most at odds with the labels"
        note="Labelled pairs for which the model finds the other clip better."
        empty="The model agrees with every label."
        experimentId={experimentId}
        pairs={odds}
      />
    </>
  );
}

interface PairsProps extends GalleryProps {
  title: string;
  note: string;
  empty: string;
}

function Pairs({ title, note, empty, experimentId, pairs }: PairsProps) {
  return (
    <section className="card" aria-label={title}>
      <h2>{title}</h2>
      <p className="muted">{pairs.length > 0 ? note : empty}</p>
      <ul className="gallery">
        {pairs.map((pair) => (
          <li key={pair.query_id}>
            <Link to={paths.pair(experimentId, pair.query_id)} className="gallery-pair">
              <span className="gallery-stills">
                {stillsOf(pair).map((url) => (
                  <img key={url} src={url} alt="" loading="lazy" width="100" height="75" />
                ))}
              </span>
              <span>Pair {pair.number}</span>
              <span className="muted">{predictionText(pair)}</span>
              <span className="muted">
                {labelsText(pair.labels, pair.left_segment)}
                {pair.label !== null && !pair.trained_on && ", not trained on"}
              </span>
            </Link>
          </li>
        ))}
      </ul>
    </section>
  );
}

/** A probability in segment order, as that of the left clip: on the side where the user sees it. */
function ofLeft(value: number, { left_segment }: PredictedPair): number {
  return left_segment === 0 ? value : 1 - value;
}

/** The stills of the left and the right clip. */
function stillsOf({ thumbnail_urls, left_segment }: PredictedPair): readonly string[] {
  return left_segment === 0 ? thumbnail_urls : thumbnail_urls.toReversed();
}

function predictionText(pair: PredictedPair): string {
  const deviation = pair.spread === null ? "" : ` ± ${formatPercent(pair.spread)}`;
  return `P(left is better) ${formatPercent(ofLeft(pair.probability, pair))}${deviation}`;
}
