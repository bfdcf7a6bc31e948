import { useQueries } from "@tanstack/react-query";
import { api, unwrap } from "@/shared/api/client";
import type { components } from "@/shared/api/schema";
import type { Query, SegmentView, Task } from "@/shared/api/types";
import type { Camera } from "@/shared/media/cameras";
import type { ClipSource } from "@/shared/media/clip";

const POLL_SECONDS = 0.4;

type View = components["schemas"]["ClipView"];

type Sides = readonly [ClipSource | null, ClipSource | null];

export interface ClipViews {
  /** the left and the right clip of a pair, both from the same camera */
  sourcesOf: (query: Query) => Sides;
  /** whether a pair is shown from the chosen camera, or why it is not */
  stateOf: (query: Query) => "shown" | "rendering" | "failed";
}

/** Requests the clips of these pairs from a camera. Until both clips of a pair are ready, it has its usual clips. */
export function useClipViews(camera: Camera, queries: readonly Query[]): ClipViews {
  const ids = camera === "follow" ? [] : queries.flatMap(({ left, right }) => [left.clip_id, right.clip_id]);
  const wanted = [...new Set(ids.filter((id) => id !== null))];
  const results = useQueries({
    queries: wanted.map((id) => ({
      queryKey: ["clip-view", id, camera],
      queryFn: () =>
        unwrap(
          api.PUT("/api/v1/clips/{clip_id}/views/{camera}", {
            params: { path: { clip_id: id, camera: camera as Task["cameras"][number] } },
          }),
        ),
      staleTime: Number.POSITIVE_INFINITY,
      refetchInterval: ({ state }: { state: { data: View | undefined } }) =>
        state.data?.status === "pending" && POLL_SECONDS * 1000,
    })),
  });
  const views = new Map(wanted.map((id, index) => [id, results[index]]));
  const urlOf = ({ clip_id }: SegmentView) => views.get(clip_id ?? "")?.data?.clip_url ?? null;
  const sourcesOf = ({ left, right }: Query): Sides => {
    const urls = [urlOf(left), urlOf(right)];
    return urls[0] && urls[1]
      ? [sourceOf(left, urls[0]), sourceOf(right, urls[1])]
      : [sourceOf(left, left.clip_url), sourceOf(right, right.clip_url)];
  };
  const stateOf = ({ left, right }: Query) => {
    if (camera === "follow" || (urlOf(left) && urlOf(right))) return "shown";
    const both = [left, right].map(({ clip_id }) => views.get(clip_id ?? ""));
    return both.some((view) => view?.isError || view?.data?.status === "failed") ? "failed" : "rendering";
  };
  return { sourcesOf, stateOf };
}

/** The clip of a segment; null in an experiment without clips. */
function sourceOf({ frames, seconds }: SegmentView, url: string | null): ClipSource | null {
  return url === null ? null : { url, frames, seconds };
}
