import { type RefObject, useCallback, useEffect, useRef, useState } from "react";
import type { Query, Task } from "@/shared/api/types";
import { type Camera, useCamera } from "@/shared/media/cameras";
import type { ClipSource } from "@/shared/media/clip";
import { ClipCache } from "@/shared/media/clipCache";
import { type PairPlayback, usePairPlayer } from "@/shared/media/usePairPlayer";
import { type ClipViews, useClipViews } from "./clipViews";
import type { Command } from "./commands";

/** Where a pair plays: its canvases, its playback, and the camera that it is shown from. */
export interface Stage {
  left: RefObject<HTMLCanvasElement | null>;
  right: RefObject<HTMLCanvasElement | null>;
  progress: RefObject<HTMLDivElement | null>;
  player: PairPlayback;
  cameras: readonly Camera[];
  camera: Camera;
  setCamera: (camera: Camera) => void;
  views: ClipViews;
  /** carries out a command of the playback or the camera; ignores others */
  run: (command: Command) => void;
}

/**
 * Plays a pair and loads the clips of others.
 *
 * @param others the pairs whose clips are kept or loaded ahead, the most urgent first.
 * @param displayCount changes with every pair displayed.
 */
export function useStage(
  task: Task,
  current: Query | null,
  others: readonly Query[],
  displayCount: number,
): Stage {
  const [clips] = useState(() => new ClipCache());
  const left = useRef<HTMLCanvasElement>(null);
  const right = useRef<HTMLCanvasElement>(null);
  const progress = useRef<HTMLDivElement>(null);
  const { cameras, camera, setCamera } = useCamera(task);
  const views = useClipViews(camera, [current, others[0]].filter(isPair));
  const [leftClip, rightClip] = current ? views.sourcesOf(current) : [null, null];
  const player = usePairPlayer(clips, leftClip, rightClip, displayCount, { left, right, progress });

  const sources = [current, ...others].filter(isPair).flatMap(views.sourcesOf).filter(isClip);
  const urls = sources.map(({ url }) => url).join();
  // biome-ignore lint/correctness/useExhaustiveDependencies: the sources change with their addresses
  useEffect(() => clips.prefetch(sources), [clips, urls]);
  useEffect(() => () => clips.clear(), [clips]);

  const { togglePause, step, setSpeed } = player;
  const run = useCallback(
    (command: Command) => {
      if (command.type === "togglePause") togglePause();
      else if (command.type === "step") step(command.direction);
      else if (command.type === "setSpeed") setSpeed(command.speed);
      else if (command.type === "nextCamera")
        setCamera(cameras[(cameras.indexOf(camera) + 1) % cameras.length] ?? "follow");
    },
    [togglePause, step, setSpeed, cameras, camera, setCamera],
  );
  return { left, right, progress, player, cameras, camera, setCamera, views, run };
}

const isPair = (query: Query | null | undefined): query is Query => Boolean(query);
const isClip = (source: ClipSource | null): source is ClipSource => source !== null;
