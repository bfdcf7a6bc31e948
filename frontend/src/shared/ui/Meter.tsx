interface MeterProps {
  label: string;
  value: number;
  max: number;
  /** what stands beside it, for example "12 of 500" */
  words: string;
}

/** How much of something is done, in a bar and in words. */
export function Meter({ label, value, max, words }: MeterProps) {
  const share = max > 0 ? Math.min(1, Math.max(0, value / max)) : 0;
  return (
    <div className="meter">
      <div className="meter-words">
        <span>{label}</span>
        <span className="number">{words}</span>
      </div>
      <div
        className="meter-bar"
        role="progressbar"
        aria-label={label}
        aria-valuemin={0}
        aria-valuemax={max}
        aria-valuenow={Math.min(value, max)}
        aria-valuetext={words}
      >
        <div style={{ width: `${100 * share}%` }} />
      </div>
    </div>
  );
}
