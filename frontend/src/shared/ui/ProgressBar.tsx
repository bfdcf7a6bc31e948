interface ProgressBarProps {
  label: string;
  value: number;
  max: number;
  /** the progress in text, for example "12 of 500" */
  text: string;
}

/** A labelled progress bar. */
export function ProgressBar({ label, value, max, text }: ProgressBarProps) {
  const fraction = max > 0 ? Math.min(1, Math.max(0, value / max)) : 0;
  return (
    <div>
      <div className="progress-text">
        <span>{label}</span>
        <span className="number">{text}</span>
      </div>
      <div
        className="progress-bar"
        role="progressbar"
        aria-label={label}
        aria-valuemin={0}
        aria-valuemax={max}
        aria-valuenow={Math.min(value, max)}
        aria-valuetext={text}
      >
        <div style={{ width: `${100 * fraction}%` }} />
      </div>
    </div>
  );
}
