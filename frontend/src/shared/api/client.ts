import createClient from "openapi-fetch";
import { ServerUnreachable, toApiError } from "./errors";
import type { paths } from "./schema";

/** The typed client of the REST API. The browser sends the sign-in cookie with every request. */
export const api = createClient<paths>({ baseUrl: "/", credentials: "same-origin" });

interface Result<Data> {
  data?: Data;
  error?: unknown;
  response: Response;
}

/**
 * Returns the data of a call.
 *
 * @throws ApiError when the server responds with an error, ServerUnreachable when it does not respond.
 */
export async function unwrap<Data>(call: Promise<Result<Data>>): Promise<Data> {
  let result: Result<Data>;
  try {
    result = await call;
  } catch (cause) {
    throw new ServerUnreachable(cause);
  }
  if (!result.response.ok) throw toApiError(result.response, result.error);
  return result.data as Data;
}
