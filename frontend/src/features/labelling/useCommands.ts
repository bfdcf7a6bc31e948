import { useEffect } from "react";
import { type Command, commandOf } from "./answers";

/** Obeys the keys of the labelling view, wherever the focus is, except where keys are typed or a dialog is open. */
export function useCommands(obey: (command: Command) => void): void {
  useEffect(() => {
    const listen = (event: KeyboardEvent) => {
      if (event.defaultPrevented || document.querySelector("dialog[open]")) return;
      const target = event.target instanceof Element ? event.target : null;
      if (target?.closest("input, textarea, select, [contenteditable]")) return;
      // Space on a button that has the focus presses it, as everywhere.
      if (event.key === " " && target?.closest("button, a")) return;
      const command = commandOf(event);
      if (!command) return;
      event.preventDefault();
      obey(command);
    };
    window.addEventListener("keydown", listen);
    return () => window.removeEventListener("keydown", listen);
  }, [obey]);
}
