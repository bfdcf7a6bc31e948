import { useCallback, useMemo, useState } from "react";
import type { Task } from "@/shared/api/types";

/** `follow` is the camera that suits the task; the others are rendered when somebody asks for them. */
export type Camera = "follow" | Task["cameras"][number];

export const CAMERA_NAMES: Readonly<Record<Camera, string>> = {
  follow: "Follow",
  side: "Side",
  top: "Above",
};

/** Where the browser keeps the chosen camera. */
const CAMERA_KEY = "accord.camera";
/** The camera that the user chose in this browser, and the next one in the list. */
export function useCamera(task: Task): {
  cameras: readonly Camera[];
  camera: Camera;
  setCamera: (camera: Camera) => void;
} {
  const cameras = useMemo((): readonly Camera[] => ["follow", ...task.cameras], [task.cameras]);
  const [chosen, setChosen] = useState<string | null>(() => localStorage.getItem(CAMERA_KEY));
  const setCamera = useCallback((camera: Camera) => {
    localStorage.setItem(CAMERA_KEY, camera);
    setChosen(camera);
  }, []);
  return { cameras, camera: cameras.find((camera) => camera === chosen) ?? "follow", setCamera };
}
