import type { VersionReport } from "@/shared/api/types";
import { Chart } from "@/shared/charts/Chart";
import { formatPercent, plural } from "@/shared/ui/format";

/** Fewer pairs say little about calibration. */
const FEW_PAIRS = 30;

/** How often a prediction was right, by its probability, on labels that the version was not trained on. */
export function Calibration({ report: { calibration, calibration_pairs } }: { report: VersionReport }) {
  if (calibration_pairs === 0) {
    return (
      <section className="card" aria-label="Calibration">
        <h2>Calibration</h2>
        <p className="muted">There is no label yet that this version was not trained on.</p>
      </section>
    );
  }
  const few = calibration_pairs < FEW_PAIRS ? " Too few to judge." : "";
  return (
    <Chart
      title="Calibration"
      note={`Share of labels that agree, by predicted probability, on ${plural(calibration_pairs, "labelled pair")} that this version was not trained on, each in both orders.${few}`}
      curves={[
        {
          name: "Labels",
          colour: "--curve-b",
          x: calibration.map(({ predicted }) => predicted),
          y: calibration.map(({ observed }) => observed),
        },
        { name: "Perfect calibration", colour: "--muted", x: [0, 1], y: [0, 1], dash: [4, 4] },
      ]}
      hasNewest={false}
      xLabel="Predicted probability"
      xMax={1}
      yMin={0}
      yMax={1}
      format={formatPercent}
      formatX={formatPercent}
      height={260}
    />
  );
}
