import type { ReactNode } from "react";
import type { FieldName } from "./fields";

interface Common {
  name: FieldName;
  label: string;
  value: string;
  hint?: string;
  /** what the server refused about this field */
  trouble: string | null;
  onChange: (value: string) => void;
}

interface FrameProps {
  field: Common;
  children: ReactNode;
}

function Frame({ field: { name, label, hint, trouble }, children }: FrameProps) {
  return (
    <div className="field" data-refused={trouble !== null || undefined}>
      <label htmlFor={name}>{label}</label>
      {children}
      {trouble ? (
        <p className="trouble" id={`${name}-words`} role="alert">
          {trouble}
        </p>
      ) : (
        <p className="quiet" id={`${name}-words`}>
          {hint}
        </p>
      )}
    </div>
  );
}

const described = ({ name, trouble }: Common) => ({
  id: name,
  name,
  "aria-describedby": `${name}-words`,
  "aria-invalid": trouble !== null,
});

interface FieldProps extends Common {
  lines?: number;
  required?: boolean;
  placeholder?: string;
}

/** Text, on one line or several. */
export function Field({ lines, required = false, placeholder, ...field }: FieldProps) {
  return (
    <Frame field={field}>
      {lines ? (
        <textarea
          {...described(field)}
          rows={lines}
          value={field.value}
          placeholder={placeholder}
          onChange={(event) => field.onChange(event.target.value)}
        />
      ) : (
        <input
          {...described(field)}
          type="text"
          required={required}
          autoComplete="off"
          value={field.value}
          placeholder={placeholder}
          onChange={(event) => field.onChange(event.target.value)}
        />
      )}
    </Frame>
  );
}

export function NumberField(field: Common) {
  return (
    <Frame field={field}>
      <input
        {...described(field)}
        type="number"
        inputMode="numeric"
        step={1}
        value={field.value}
        onChange={(event) => field.onChange(event.target.value)}
      />
    </Frame>
  );
}

interface ChoiceProps extends Common {
  choices: { value: string; words: string }[];
}

export function ChoiceField({ choices, ...field }: ChoiceProps) {
  return (
    <Frame field={field}>
      <select
        {...described(field)}
        value={field.value}
        onChange={(event) => field.onChange(event.target.value)}
      >
        {choices.map(({ value, words }) => (
          <option key={value} value={value}>
            {words}
          </option>
        ))}
      </select>
    </Frame>
  );
}
