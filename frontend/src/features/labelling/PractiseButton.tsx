import { useQuery } from "@tanstack/react-query";
import { practiceQuery } from "@/shared/api/queries";
import type { Experiment, Query } from "@/shared/api/types";
import { plural } from "@/shared/ui/format";

interface PractiseButtonProps {
  experiment: Experiment;
  onPractise: (pairs: readonly Query[]) => void;
}

/** Starts a practice round; nothing while there are no practice pairs with clips. */
export function PractiseButton({ experiment, onPractise }: PractiseButtonProps) {
  const { data } = useQuery(practiceQuery(experiment.id));
  if (!data || data.items.length === 0) return null;
  return (
    <button type="button" className="button" onClick={() => onPractise(data.items)}>
      Practise on {plural(data.items.length, "pair")}
    </button>
  );
}
