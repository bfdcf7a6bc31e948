import type { Query, SegmentView } from "@/shared/api/types";
import type { ClipSource } from "@/shared/media/clip";

/** What the player needs to know of one side; null for an experiment that makes no clips. */
export function sourceOf(side: SegmentView): ClipSource | null {
  if (side.clip_url === null) return null;
  return { url: side.clip_url, frames: side.frames, seconds: side.seconds };
}

/** Clips of some pairs, in the order of the pairs. */
export function sourcesOf(queries: readonly (Query | null | undefined)[]): ClipSource[] {
  return queries
    .flatMap((query) => (query ? [sourceOf(query.left), sourceOf(query.right)] : []))
    .filter(isSource);
}

function isSource(source: ClipSource | null): source is ClipSource {
  return source !== null;
}
