import createClient from "openapi-fetch";
import { errorOf, Unreachable } from "./errors";
import type { paths } from "./schema";

/** The typed client of the REST API; the sign-in cookie goes along by itself. */
export const api = createClient<paths>({ baseUrl: "/", credentials: "same-origin" });

interface Outcome<Data> {
  data?: Data;
  error?: unknown;
  response: Response;
}

/**
 * The data of a call.
 *
 * @throws ApiError when the server refuses, Unreachable when it does not answer.
 */
export async function unwrap<Data>(call: Promise<Outcome<Data>>): Promise<Data> {
  let outcome: Outcome<Data>;
  try {
    outcome = await call;
  } catch (cause) {
    throw new Unreachable(cause);
  }
  if (!outcome.response.ok) throw errorOf(outcome.response, outcome.error);
  return outcome.data as Data;
}
