import { useEffect, useId, useRef, useState } from "react";
import uPlot from "uplot";
import { optionsOf } from "./chartOptions";
import "uplot/dist/uPlot.min.css";

export interface Curve {
  x: number[];
  y: number[];
}

/** A vertical line with a name. */
export interface Mark {
  x: number;
  name: string;
}

export interface ChartProps {
  title: string;
  curve: Curve;
  marks: readonly Mark[];
  xLabel: string;
  xMax: number;
  yMin?: number;
  yMax?: number;
  format: (value: number) => string;
  formatX: (value: number) => string;
  tone: "a" | "b" | "c" | "d";
  dots?: boolean;
  /** only whole numbers on the y axis */
  whole?: boolean;
}

const HEIGHT = 200;

/** One live curve. Its newest value stands in words beside its title, for those who do not see the picture. */
export function Chart(props: ChartProps) {
  const { title, curve, format } = props;
  const place = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const latest = useRef(props);
  const scheme = useScheme();
  const titleId = useId();
  latest.current = props;

  // biome-ignore lint/correctness/useExhaustiveDependencies: other properties reach the plot through `latest`
  useEffect(() => {
    const element = place.current;
    if (!element) return;
    const drawn = new uPlot(optionsOf(latest, element, HEIGHT), dataOf(latest.current.curve), element);
    plot.current = drawn;
    const observer = new ResizeObserver(() => drawn.setSize({ width: element.clientWidth, height: HEIGHT }));
    observer.observe(element);
    return () => {
      observer.disconnect();
      drawn.destroy();
      plot.current = null;
    };
  }, [scheme]);

  // biome-ignore lint/correctness/useExhaustiveDependencies: new marks are drawn with the same data
  useEffect(() => {
    plot.current?.setData(dataOf(curve));
  }, [curve, props.marks, props.xMax]);

  const newest = curve.y.at(-1);
  return (
    <section className="card chart" aria-labelledby={titleId} data-points={curve.x.length}>
      <h2 id={titleId}>
        {title}{" "}
        <span className="number chart-newest">{newest === undefined ? "no data yet" : format(newest)}</span>
      </h2>
      <div ref={place} className="chart-place" style={{ height: HEIGHT }} aria-hidden="true" />
    </section>
  );
}

function dataOf({ x, y }: Curve): uPlot.AlignedData {
  return [x, y];
}

/** Grows when the colour scheme of the system changes: colours on a canvas do not follow by themselves. */
function useScheme(): number {
  const [count, setCount] = useState(0);
  useEffect(() => {
    const dark = window.matchMedia("(prefers-color-scheme: dark)");
    const changed = () => setCount((old) => old + 1);
    dark.addEventListener("change", changed);
    return () => dark.removeEventListener("change", changed);
  }, []);
  return count;
}
