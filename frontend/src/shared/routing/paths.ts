/** URL paths of the pages. */
export const paths = {
  experiments: () => "/",
  newExperiment: () => "/experiments/new",
  cloneExperiment: (id: string) => `/experiments/new?from=${encodeURIComponent(id)}`,
  compare: (ids: readonly string[]) => `/compare/${ids.map(encodeURIComponent).join(",")}`,
  experiment: (id: string) => `/experiments/${encodeURIComponent(id)}`,
  label: (id: string) => `/experiments/${encodeURIComponent(id)}/label`,
  labels: (id: string) => `/experiments/${encodeURIComponent(id)}/labels`,
  /** Whether the server answered a one-time sign-in link with this page, because the link was not valid. */
  isSignInLink: (path: string) => path.startsWith("/sign-in/"),
};

export type Route =
  | { page: "experiments" }
  | { page: "new-experiment" }
  | { page: "experiment"; id: string }
  | { page: "label"; id: string }
  | { page: "compare"; ids: string[] }
  | { page: "labels"; id: string }
  | { page: "missing" };

export function routeOf(path: string): Route {
  const parts = partsOf(path);
  if (parts === undefined || parts.length > 3) return { page: "missing" };
  const [first, second, third] = parts;
  if (first === undefined || paths.isSignInLink(path) || (first === "experiments" && second === undefined))
    return { page: "experiments" };
  if (first === "compare" && second !== undefined && third === undefined)
    return { page: "compare", ids: second.split(",") };
  if (first !== "experiments" || second === undefined) return { page: "missing" };
  if (second === "new") return third === undefined ? { page: "new-experiment" } : { page: "missing" };
  if (third === undefined) return { page: "experiment", id: second };
  return third === "label" || third === "labels" ? { page: third, id: second } : { page: "missing" };
}

/** The decoded parts of a path; undefined if a percent sign in it begins no character. */
function partsOf(path: string): string[] | undefined {
  try {
    return path
      .split("/")
      .filter((part) => part !== "")
      .map(decodeURIComponent);
  } catch (error) {
    if (error instanceof URIError) return undefined;
    throw error;
  }
}
