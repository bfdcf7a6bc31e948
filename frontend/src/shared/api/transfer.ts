import { reportSignedOut } from "./client";
import { ServerUnreachable, toApiError } from "./errors";

/**
 * Downloads a file.
 *
 * @param onProgress is called with the share that has been received, from 0 to 1.
 * @throws ApiError, ServerUnreachable
 */
export async function receiveFile(
  path: string,
  onProgress: (share: number) => void,
  signal: AbortSignal,
): Promise<Blob> {
  let response: Response;
  try {
    response = await fetch(path, { credentials: "same-origin", signal });
    if (response.ok && response.body) {
      const total = Number(response.headers.get("content-length")) || Number.POSITIVE_INFINITY;
      let received = 0;
      const counted = response.body.pipeThrough(
        new TransformStream<Uint8Array<ArrayBuffer>, Uint8Array<ArrayBuffer>>({
          transform(chunk, controller) {
            received += chunk.byteLength;
            onProgress(received / total);
            controller.enqueue(chunk);
          },
        }),
      );
      return await new Response(counted).blob();
    }
  } catch (cause) {
    throw new ServerUnreachable(cause);
  }
  if (response.status === 401) reportSignedOut();
  throw toApiError(response, await response.json().catch(() => null));
}

/**
 * Uploads a file and returns the response. Not by `fetch`, which does not tell how much was sent.
 *
 * @param onProgress is called with the share that has been sent, from 0 to 1.
 * @throws ApiError, ServerUnreachable
 */
export function sendFile<Data>(
  path: string,
  file: Blob,
  onProgress: (share: number) => void,
  signal: AbortSignal,
): Promise<Data> {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    signal.addEventListener("abort", () => request.abort());
    request.upload.onprogress = ({ loaded, total }) => onProgress(total > 0 ? loaded / total : 1);
    request.onload = () => {
      const body: unknown = parsed(request.responseText);
      if (request.status < 300) resolve(body as Data);
      else {
        if (request.status === 401) reportSignedOut();
        reject(toApiError(new Response(null, { status: request.status }), body));
      }
    };
    request.onerror = request.onabort = () => reject(new ServerUnreachable(null));
    request.open("POST", path);
    request.setRequestHeader("Content-Type", "application/zip");
    request.send(file);
  });
}

function parsed(text: string): unknown {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}
