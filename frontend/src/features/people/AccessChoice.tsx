import { useQuery } from "@tanstack/react-query";
import { useId } from "react";
import { experimentChoicesQuery } from "@/shared/api/queries";
import type { Access } from "@/shared/api/types";

interface AccessChoiceProps {
  access: Access;
  onChange: (access: Access) => void;
}

/** Which experiments somebody sees: all, also later ones, or those that are checked. */
export function AccessChoice({ access, onChange }: AccessChoiceProps) {
  const name = useId();
  const { data } = useQuery(experimentChoicesQuery);
  const { all_experiments: all, experiment_ids: chosen = [] } = access;
  const toggle = (id: string, on: boolean) =>
    onChange({
      all_experiments: false,
      experiment_ids: on ? [...chosen, id] : chosen.filter((each) => each !== id),
    });
  return (
    <fieldset className="access">
      <legend>Sees</legend>
      <label>
        <input
          type="radio"
          name={name}
          checked={all}
          onChange={() => onChange({ ...access, all_experiments: true })}
        />
        All experiments, also those that start later
      </label>
      <label>
        <input
          type="radio"
          name={name}
          checked={!all}
          onChange={() => onChange({ ...access, all_experiments: false })}
        />
        Only these:
      </label>
      <ul className="access-list">
        {data?.items.map((experiment) => (
          <li key={experiment.id}>
            <label>
              <input
                type="checkbox"
                disabled={all}
                checked={!all && chosen.includes(experiment.id)}
                onChange={(event) => toggle(experiment.id, event.target.checked)}
              />
              {experiment.name}
            </label>
          </li>
        ))}
        {data?.items.length === 0 && <li className="muted">There are no experiments yet.</li>}
      </ul>
    </fieldset>
  );
}
