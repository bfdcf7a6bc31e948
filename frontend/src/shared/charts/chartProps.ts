import type { Curve } from "./curves";

/** A named vertical line. */
export interface Marker {
  x: number;
  name: string;
}

/** A named horizontal line. */
export interface Reference {
  y: number;
  name: string;
}

export interface ChartProps {
  title: string;
  /** what the numbers are, below the title */
  note?: string;
  /** whether the newest values are given as text; false where x is no time */
  hasNewest?: boolean;
  /** in place of the newest value of the only curve */
  value?: string | undefined;
  curves: readonly Curve[];
  markers?: readonly Marker[];
  references?: readonly Reference[];
  xLabel: string;
  xMax: number;
  yMin?: number;
  yMax?: number;
  format: (value: number) => string;
  formatX: (value: number) => string;
  /** x counts reward versions from 1: draw a dot for each */
  perVersion?: boolean;
  /** only integers on the y axis */
  integers?: boolean;
  /** of the canvas in pixels */
  height?: number;
}

/** What a chart draws: its properties, and the range of x that the user has zoomed into. */
export interface ChartState extends ChartProps {
  zoom: [number, number] | null;
}

/** What the user does with the pointer. */
export interface ChartEvents {
  /** the index in the aligned table under the pointer; null outside the chart */
  onHover: (index: number | null) => void;
  onZoom: (range: [number, number] | null) => void;
}
