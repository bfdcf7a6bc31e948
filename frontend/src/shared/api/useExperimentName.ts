import { useQuery } from "@tanstack/react-query";
import { experimentChoicesQuery } from "./queries";

/** Returns the name of an experiment by its id, also while the names are loaded. */
export function useExperimentName(): (id: string) => string {
  const { data } = useQuery(experimentChoicesQuery);
  return (id) => data?.items.find((each) => each.id === id)?.name ?? "One experiment";
}
