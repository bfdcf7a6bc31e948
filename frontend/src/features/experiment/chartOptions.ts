import type { RefObject } from "react";
import type uPlot from "uplot";

export interface Curve {
  x: number[];
  y: number[];
}

/** A named vertical line. */
export interface Marker {
  x: number;
  name: string;
}

export interface ChartProps {
  title: string;
  curve: Curve;
  markers: readonly Marker[];
  xLabel: string;
  xMax: number;
  yMin?: number;
  yMax?: number;
  format: (value: number) => string;
  formatX: (value: number) => string;
  /** one of the --curve-* colours of the theme */
  colour: "a" | "b" | "c" | "d";
  /** x counts reward versions from 1: draw a dot for each */
  perVersion?: boolean;
  /** only integers on the y axis */
  integers?: boolean;
}

/** Margin above and below a curve, as a fraction of its range, or of its value when it is constant. */
const MARGIN = 0.1;

const INTEGER_INCREMENTS = [
  1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 50_000, 100_000, 1_000_000,
];

/** Curves with fewer points are drawn with dots, since a line through one point is invisible. */
const MIN_POINTS_WITHOUT_DOTS = 4;

/** The uPlot options of a chart. They read `latest` on every draw, so that new properties need no new plot. */
export function chartOptions(
  latest: RefObject<ChartProps>,
  element: HTMLElement,
  height: number,
): uPlot.Options {
  const { colour, perVersion, integers, xLabel } = latest.current;
  const style = getComputedStyle(element);
  const textColour = style.getPropertyValue("--muted");
  const stroke = style.getPropertyValue(`--curve-${colour}`);
  const axis = {
    stroke: textColour,
    grid: { stroke: style.getPropertyValue("--line"), width: 1 },
    ticks: { show: false },
    font: "12px system-ui",
  };
  return {
    width: element.clientWidth || 400,
    height,
    cursor: { y: false, points: { size: 7 } },
    legend: { show: false },
    scales: {
      x: { time: false, range: () => rangeX(latest.current) },
      y: { range: (_, low, high) => rangeY(latest.current, low, high) },
    },
    axes: [
      {
        ...axis,
        label: xLabel,
        labelSize: 18,
        labelFont: "12px system-ui",
        size: 30,
        values: (_, ticks) => ticks.map(latest.current.formatX),
      },
      {
        ...axis,
        ...(integers && { incrs: INTEGER_INCREMENTS }),
        size: 54,
        values: (_, ticks) => ticks.map(latest.current.format),
      },
    ],
    series: [
      {},
      {
        stroke,
        width: 2,
        points: {
          show: () => perVersion === true || latest.current.curve.x.length < MIN_POINTS_WITHOUT_DOTS,
          size: 7,
          fill: stroke,
        },
      },
    ],
    hooks: {
      draw: [(plot) => drawMarkers(plot, latest.current, textColour)],
      setCursor: [(plot) => showHoveredValue(plot, latest.current)],
    },
  };
}

function rangeX({ curve, xMax, perVersion }: ChartProps): [number, number] {
  const max = Math.max(xMax, curve.x.at(-1) ?? 1);
  return perVersion ? [0.5, max + 0.5] : [0, max];
}

function rangeY({ yMin, yMax }: ChartProps, low: number | null, high: number | null): [number, number] {
  if (low === null || high === null) return [yMin ?? 0, yMax ?? 1];
  const margin = (high - low) * MARGIN || Math.abs(high) * MARGIN || 1;
  return [yMin === undefined || low < yMin ? low - margin : yMin, yMax ?? high + margin];
}

/** Draws a dashed line for every marker, and its name where it does not overlap the previous one. */
function drawMarkers(plot: uPlot, { markers }: ChartProps, colour: string): void {
  const { ctx, bbox } = plot;
  const ratio = devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = colour;
  ctx.fillStyle = colour;
  ctx.globalAlpha = 0.7;
  ctx.lineWidth = ratio;
  ctx.setLineDash([3 * ratio, 3 * ratio]);
  ctx.font = `${11 * ratio}px system-ui`;
  ctx.textAlign = "left";
  let textEnd = Number.NEGATIVE_INFINITY;
  for (const { x, name } of [...markers].sort((a, b) => a.x - b.x)) {
    const pixel = Math.round(plot.valToPos(x, "x", true));
    ctx.beginPath();
    ctx.moveTo(pixel, bbox.top);
    ctx.lineTo(pixel, bbox.top + bbox.height);
    ctx.stroke();
    if (pixel < textEnd) continue;
    ctx.fillText(name, pixel + 3 * ratio, bbox.top + 10 * ratio);
    textEnd = pixel + ctx.measureText(name).width + 8 * ratio;
  }
  ctx.restore();
}

/** Shows the value under the pointer in place of the newest one. */
function showHoveredValue(plot: uPlot, { curve, format, formatX }: ChartProps): void {
  const element = plot.root.closest(".chart")?.querySelector<HTMLElement>(".chart-value");
  if (!element) return;
  const index = plot.cursor.idx;
  const x = index == null ? undefined : curve.x[index];
  const y = index == null ? undefined : curve.y[index];
  if (x !== undefined && y !== undefined) element.dataset.hover = `${format(y)} at ${formatX(x)}`;
  else delete element.dataset.hover;
}
