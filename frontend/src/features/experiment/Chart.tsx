import { useEffect, useId, useRef, useState } from "react";
import uPlot from "uplot";
import { type ChartProps, type Curve, chartOptions } from "./chartOptions";
import "uplot/dist/uPlot.min.css";

const HEIGHT = 200;

/** A live chart of one curve. The newest value is also given as text, next to the title. */
export function Chart(props: ChartProps) {
  const { title, curve, format } = props;
  const container = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const latest = useRef(props);
  const colourScheme = useColourScheme();
  const titleId = useId();
  latest.current = props;

  // biome-ignore lint/correctness/useExhaustiveDependencies: the plot reads other properties from `latest`
  useEffect(() => {
    const element = container.current;
    if (!element) return;
    const created = new uPlot(chartOptions(latest, element, HEIGHT), dataOf(latest.current.curve), element);
    plot.current = created;
    const observer = new ResizeObserver(() =>
      created.setSize({ width: element.clientWidth, height: HEIGHT }),
    );
    observer.observe(element);
    return () => {
      observer.disconnect();
      created.destroy();
      plot.current = null;
    };
  }, [colourScheme]);

  // biome-ignore lint/correctness/useExhaustiveDependencies: new markers or limits need a redraw, too
  useEffect(() => {
    plot.current?.setData(dataOf(curve));
  }, [curve, props.markers, props.xMax]);

  const newest = curve.y.at(-1);
  return (
    <section className="card chart" aria-labelledby={titleId} data-points={curve.x.length}>
      <h2 id={titleId}>
        {title}{" "}
        <span className="number chart-value">{newest === undefined ? "No data yet" : format(newest)}</span>
      </h2>
      <div ref={container} className="chart-canvas" style={{ height: HEIGHT }} aria-hidden="true" />
    </section>
  );
}

function dataOf({ x, y }: Curve): uPlot.AlignedData {
  return [x, y];
}

/** A number that changes with the system's colour scheme: a canvas has to be redrawn with the new colours. */
function useColourScheme(): number {
  const [changes, setChanges] = useState(0);
  useEffect(() => {
    const dark = window.matchMedia("(prefers-color-scheme: dark)");
    const update = () => setChanges((count) => count + 1);
    dark.addEventListener("change", update);
    return () => dark.removeEventListener("change", update);
  }, []);
  return changes;
}
