import { type MouseEvent, type PointerEvent, type RefObject, useRef, useState } from "react";
import type { Task } from "@/shared/api/types";
import { agentAt, agentsAt } from "./hoveredAgent";

interface Hovered {
  name: string;
  left: number;
  top: number;
}

/**
 * The name of the agent under the mouse. Returns the name's label and the handlers of the clip.
 *
 * @param onAgents called with the agents of a clicked limb: several if they share its colour; null to ignore clicks
 */
export function useAgentName(
  canvas: RefObject<HTMLCanvasElement | null>,
  task: Task,
  onAgents: ((agents: readonly number[]) => void) | null,
) {
  const [hovered, setHovered] = useState<Hovered | null>(null);
  const probe = useRef<CanvasRenderingContext2D | null>(null);
  /** Where the mouse is on the clip, and the colour there; null before the first frame. */
  const pixelAt = (event: MouseEvent<HTMLElement>) => {
    if (!canvas.current?.width) return null;
    const { width, height } = canvas.current;
    const box = canvas.current.getBoundingClientRect();
    const left = event.clientX - box.left;
    const top = event.clientY - box.top;
    const [x, y] = [(left * width) / box.width, (top * height) / box.height].map(Math.floor);
    probe.current ??= createProbe();
    probe.current?.drawImage(canvas.current, x ?? 0, y ?? 0, 1, 1, 0, 0, 1, 1);
    const pixel = probe.current?.getImageData(0, 0, 1, 1).data;
    return pixel ? { left, top, colour: [pixel[0] ?? 0, pixel[1] ?? 0, pixel[2] ?? 0] as const } : null;
  };
  const onPointerMove = (event: PointerEvent<HTMLElement>) => {
    const found = event.pointerType === "mouse" ? pixelAt(event) : null;
    const name = found && agentAt(found.colour, task);
    setHovered(found && name ? { name, left: found.left, top: found.top } : null);
  };
  const onClick = (event: MouseEvent<HTMLElement>) => {
    const found = pixelAt(event);
    const agents = found ? agentsAt(found.colour, task) : [];
    if (agents.length > 0) onAgents?.(agents);
  };
  const label = hovered && (
    <span className="agent-name" style={{ left: hovered.left, top: hovered.top }} aria-hidden="true">
      {hovered.name}
    </span>
  );
  return { label, handlers: { onPointerMove, onPointerLeave: () => setHovered(null), onClick } };
}

/** A canvas of one pixel, so that reading a pixel does not slow down the canvas of the clip. */
function createProbe(): CanvasRenderingContext2D | null {
  const canvas = document.createElement("canvas");
  canvas.width = 1;
  canvas.height = 1;
  return canvas.getContext("2d", { willReadFrequently: true });
}
