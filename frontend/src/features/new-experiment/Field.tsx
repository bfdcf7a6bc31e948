import type { ReactNode } from "react";
import type { FieldSpec } from "./fields";

interface FieldProps {
  field: FieldSpec;
  value: string;
  /** the server's error about this field */
  error: string | null;
  onChange: (value: string) => void;
  /** in place of the server's default */
  placeholder?: string;
  /** in place of the choices of the schema */
  options?: { value: string; text: string }[];
  /** a text area with so many lines */
  lines?: number;
  /** shown after the help */
  note?: string;
}

/** A labelled input for one setting, with its unit, its range and its help or error. */
export function Field({ field, value, error, onChange, placeholder, options, lines, note }: FieldProps) {
  const { name, kind, unit } = field;
  const helpId = `${name}-help`;
  const common = {
    id: name,
    name,
    required: field.required,
    "aria-describedby": helpId,
    "aria-invalid": error !== null,
    onChange: (event: { target: { value: string } }) => onChange(event.target.value),
  };
  const hint = placeholder ?? field.default;
  let input: ReactNode;
  if (options) {
    input = <Select common={common} value={value} options={options} />;
  } else if (kind === "choice" || kind === "boolean") {
    input = <Select common={common} value={value || field.default} options={choicesOf(field)} />;
  } else if (kind === "integer" || kind === "number") {
    input = (
      <input
        {...common}
        type="number"
        inputMode={kind === "integer" ? "numeric" : "decimal"}
        step={kind === "integer" ? 1 : "any"}
        min={field.min}
        max={field.max}
        value={value}
        placeholder={hint}
      />
    );
  } else if (lines) {
    input = (
      <textarea {...common} rows={lines} maxLength={field.maxLength} value={value} placeholder={hint} />
    );
  } else {
    input = (
      <input
        {...common}
        type="text"
        autoComplete="off"
        maxLength={field.maxLength}
        value={value}
        placeholder={hint}
      />
    );
  }
  return (
    <div className="field" data-invalid={error !== null || undefined}>
      <label htmlFor={name}>{field.label}</label>
      <div className="field-input">
        {input}
        {unit && <span className="muted">{unit}</span>}
      </div>
      {error && (
        <p className="alert" role="alert">
          {error}
        </p>
      )}
      <p className="muted" id={helpId}>
        {[field.help, field.range, note].filter(Boolean).join(" ")}
      </p>
    </div>
  );
}

interface SelectProps {
  common: React.SelectHTMLAttributes<HTMLSelectElement>;
  value: string;
  options: { value: string; text: string }[];
}

function Select({ common, value, options }: SelectProps) {
  return (
    <select {...common} value={value}>
      {options.map((option) => (
        <option key={option.value} value={option.value}>
          {option.text}
        </option>
      ))}
    </select>
  );
}

function choicesOf({ kind, choices }: FieldSpec): { value: string; text: string }[] {
  if (kind === "choice") return choices.map((choice) => ({ value: choice, text: choice }));
  return [
    { value: "true", text: "yes" },
    { value: "false", text: "no" },
  ];
}
