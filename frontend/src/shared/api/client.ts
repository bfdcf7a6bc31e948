import createClient from "openapi-fetch";
import { ServerUnreachable, toApiError } from "./errors";
import type { paths } from "./schema";

/** The typed client of the REST API. The browser sends the sign-in cookie with every request. */
export const api = createClient<paths>({ baseUrl: "/", credentials: "same-origin" });

const ME = "/api/v1/me";
const signedOutListeners = new Set<() => void>();

/** Calls back when a request finds that nobody is signed in any more. Returns a function that unsubscribes. */
export function onSignedOut(listener: () => void): () => void {
  signedOutListeners.add(listener);
  return () => signedOutListeners.delete(listener);
}

/** Tells the listeners that a request was refused because nobody is signed in. */
export function reportSignedOut(): void {
  for (const listener of signedOutListeners) listener();
}

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
  const { response } = result;
  if (!response.ok) {
    // The request for the user itself needs no notice: whoever sent it handles the error.
    if (response.status === 401 && !response.url.endsWith(ME)) reportSignedOut();
    throw toApiError(response, result.error);
  }
  return result.data as Data;
}
