import type { RefObject } from "react";
import type uPlot from "uplot";
import type { ChartProps } from "./Chart";

/** A curve that does not move still gets a scale, this share of its value above and below. */
const FLAT_MARGIN = 0.1;

const WHOLE_STEPS = [
  1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 50_000, 100_000, 1_000_000,
];

/** Up to so many points each has a dot: a line through one point would not be seen. */
const FEW_POINTS = 4;

/** How uPlot draws a chart. It reads `latest` whenever it draws, so that it need not be made anew. */
export function optionsOf(
  latest: RefObject<ChartProps>,
  element: HTMLElement,
  height: number,
): uPlot.Options {
  const { tone, dots, whole, xLabel } = latest.current;
  const colours = getComputedStyle(element);
  const ink = colours.getPropertyValue("--muted");
  const line = colours.getPropertyValue("--line");
  const stroke = colours.getPropertyValue(`--curve-${tone}`);
  const axis = {
    stroke: ink,
    grid: { stroke: line, width: 1 },
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
        ...(whole && { incrs: WHOLE_STEPS }),
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
          show: () => dots === true || latest.current.curve.x.length < FEW_POINTS,
          size: 7,
          fill: stroke,
        },
      },
    ],
    hooks: {
      draw: [(plot) => drawMarks(plot, latest.current, ink)],
      setCursor: [(plot) => showValue(plot, latest.current)],
    },
  };
}

function rangeX({ curve, xMax, dots }: ChartProps): [number, number] {
  return dots ? [0.5, Math.max(xMax, curve.x.at(-1) ?? 1) + 0.5] : [0, Math.max(xMax, curve.x.at(-1) ?? 1)];
}

function rangeY({ yMin, yMax }: ChartProps, low: number | null, high: number | null): [number, number] {
  const from = low ?? 0;
  const to = high ?? 1;
  const margin = (to - from) * FLAT_MARGIN || Math.abs(to) * FLAT_MARGIN || 1;
  return [yMin === undefined || from < yMin ? from - margin : yMin, yMax ?? to + margin];
}

/** Vertical lines where reward versions came into force. Names that would overlap are left out. */
function drawMarks(plot: uPlot, { marks }: ChartProps, ink: string): void {
  const { ctx, bbox } = plot;
  const ratio = devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = ink;
  ctx.fillStyle = ink;
  ctx.globalAlpha = 0.7;
  ctx.lineWidth = ratio;
  ctx.setLineDash([3 * ratio, 3 * ratio]);
  ctx.font = `${11 * ratio}px system-ui`;
  ctx.textAlign = "left";
  let free = Number.NEGATIVE_INFINITY;
  for (const { x, name } of [...marks].sort((a, b) => a.x - b.x)) {
    const at = Math.round(plot.valToPos(x, "x", true));
    ctx.beginPath();
    ctx.moveTo(at, bbox.top);
    ctx.lineTo(at, bbox.top + bbox.height);
    ctx.stroke();
    if (at < free) continue;
    ctx.fillText(name, at + 3 * ratio, bbox.top + 10 * ratio);
    free = at + ctx.measureText(name).width + 8 * ratio;
  }
  ctx.restore();
}

/** The value under the pointer stands in the title until the pointer leaves. */
function showValue(plot: uPlot, { curve, format, formatX }: ChartProps): void {
  const words = plot.root.closest(".chart")?.querySelector<HTMLElement>(".chart-newest");
  if (!words) return;
  const index = plot.cursor.idx;
  const x = index == null ? undefined : curve.x[index];
  const y = index == null ? undefined : curve.y[index];
  if (x !== undefined && y !== undefined) words.dataset.under = `${format(y)} at ${formatX(x)}`;
  else delete words.dataset.under;
}
