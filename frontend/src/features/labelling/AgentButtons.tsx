import type { Task } from "@/shared/api/types";
import { AgentSwatch } from "@/shared/ui/AgentSwatch";
import { Key } from "@/shared/ui/Key";
import { blurAfterMouseClick } from "./ChoiceButtons";
import { AGENT_KEYS } from "./commands";
import "./agent-buttons.css";

interface AgentButtonsProps {
  task: Task;
  enabled: boolean;
  /** the agent marked for the pair on screen */
  marked: number | null;
  onMark: (agent: number) => void;
}

/** One button per agent, to mark the one that decides the answer. The mark goes with the answer, and is optional. */
export function AgentButtons({ task, enabled, marked, onMark }: AgentButtonsProps) {
  return (
    <fieldset className="agent-buttons" aria-label="Which agent decides your answer? Optional.">
      <span className="agent-question" aria-hidden="true">
        Decided by <span className="muted">(optional)</span>
      </span>
      <div className="agent-row">
        {task.agent_names.map((name, agent) => (
          <button
            key={name}
            type="button"
            className="button small agent-button"
            aria-pressed={marked === agent}
            aria-disabled={!enabled}
            aria-keyshortcuts={AGENT_KEYS[agent]}
            onClick={(event) => {
              blurAfterMouseClick(event);
              if (enabled) onMark(agent);
            }}
          >
            {AGENT_KEYS[agent] && (
              <span className="for-keys">
                <Key name={AGENT_KEYS[agent]} />
              </span>
            )}
            <AgentSwatch colours={task.agent_colours} agent={agent} />
            {name}
          </button>
        ))}
      </div>
    </fieldset>
  );
}
