import { useId } from "react";

interface SmoothingProps {
  /** weight of the past in the moving average */
  value: number;
  onChange: (value: number) => void;
}

/** The controls of charts: the smoothing, and how to zoom. */
export function Smoothing({ value, onChange }: SmoothingProps) {
  const id = useId();
  return (
    <div className="chart-controls">
      <label htmlFor={id}>Smoothing</label>
      <input
        id={id}
        type="range"
        min={0}
        max={0.98}
        step={0.02}
        value={value}
        aria-valuetext={value === 0 ? "none" : value.toFixed(2)}
        onChange={(event) => onChange(Number(event.target.value))}
      />
      <span className="number muted">{value === 0 ? "none" : value.toFixed(2)}</span>
      <span className="muted chart-hint">Drag over a chart to zoom in, double-click to zoom out.</span>
    </div>
  );
}
