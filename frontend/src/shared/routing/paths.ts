/** URL paths of the pages. */
export const paths = {
  experiments: () => "/",
  newExperiment: () => "/experiments/new",
  cloneExperiment: (id: string) => `/experiments/new?from=${encodeURIComponent(id)}`,
  trainOn: (id: string) => `/experiments/new?from=${encodeURIComponent(id)}&policy=${encodeURIComponent(id)}`,
  compare: (ids: readonly string[]) => `/compare/${ids.map(encodeURIComponent).join(",")}`,
  experiment: (id: string) => `/experiments/${encodeURIComponent(id)}`,
  label: (id: string) => `/experiments/${encodeURIComponent(id)}/label`,
  pair: (id: string, query: string) =>
    `/experiments/${encodeURIComponent(id)}/pairs/${encodeURIComponent(query)}`,
  reward: (id: string) => `/experiments/${encodeURIComponent(id)}/reward`,
  policies: (id: string) => `/experiments/${encodeURIComponent(id)}/policies`,
  labels: (id: string) => `/experiments/${encodeURIComponent(id)}/labels`,
  people: () => "/people",
  audit: () => "/audit",
  account: () => "/account",
  /** The server lets only this path below /api through to the page. */
  apiDocs: () => "/api/docs",
  /** The token of an invitation, if the path is its link. */
  invitationOf: (path: string) => /^\/join\/([^/]+)$/.exec(path)?.[1] ?? null,
  /** The token of a read-only link, which is in its fragment; null if the address is no such link. */
  sharedToken: ({ pathname, hash }: { pathname: string; hash: string }) =>
    pathname === "/shared" ? hash.slice(1) : null,
  quality: (id: string) => `/experiments/${encodeURIComponent(id)}/quality`,
  decide: (id: string) => `/experiments/${encodeURIComponent(id)}/decide`,
  /** The token of a one-time sign-in link, if the path is one. */
  signInLinkOf: (path: string) => /^\/sign-in\/([^/]+)$/.exec(path)?.[1] ?? null,
};

export type Route =
  | { page: "experiments" }
  | { page: "new-experiment" }
  | { page: "experiment"; id: string }
  | { page: "label"; id: string }
  | { page: "compare"; ids: string[] }
  | { page: "labels"; id: string }
  | { page: "people" }
  | { page: "audit" }
  | { page: "account" }
  | { page: "api-docs" }
  | { page: "quality"; id: string }
  | { page: "decide"; id: string }
  | { page: "reward"; id: string }
  | { page: "policies"; id: string }
  | { page: "pair"; id: string; query: string }
  | { page: "missing" };

/** The pages below an experiment, by the last part of their path. */
const OF_EXPERIMENT = ["label", "labels", "quality", "decide", "reward", "policies"] as const;

export function routeOf(path: string): Route {
  const parts = partsOf(path);
  if (parts === undefined || parts.length > 4) return { page: "missing" };
  const [first, second, third, fourth] = parts;
  if (first === undefined || (first === "experiments" && second === undefined))
    return { page: "experiments" };
  if (first === "compare" && second !== undefined && third === undefined)
    return { page: "compare", ids: second.split(",") };
  if (first === "people" && second === undefined) return { page: "people" };
  if (path === paths.apiDocs()) return { page: "api-docs" };
  if (first === "audit" && second === undefined) return { page: "audit" };
  if (first === "account" && second === undefined) return { page: "account" };
  if (first !== "experiments" || second === undefined) return { page: "missing" };
  if (second === "new") return third === undefined ? { page: "new-experiment" } : { page: "missing" };
  if (third === undefined) return { page: "experiment", id: second };
  if (third === "pairs" && fourth !== undefined) return { page: "pair", id: second, query: fourth };
  if (fourth !== undefined) return { page: "missing" };
  const page = OF_EXPERIMENT.find((each) => each === third);
  return page ? { page, id: second } : { page: "missing" };
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
