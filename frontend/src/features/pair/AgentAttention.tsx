import type { SegmentCredit, Task } from "@/shared/api/types";
import { AgentSwatch } from "@/shared/ui/AgentSwatch";
import { ScrollingTable } from "@/shared/ui/ScrollingTable";

/** Part of the accent colour at an attention of 1: text on it stays readable. */
const STRONGEST = 45;

interface AgentAttentionProps {
  name: string;
  credit: SegmentCredit;
  task: Task;
}

/** How much the reward of each agent (row) depends on each agent (column): mean attention over the steps. */
export function AgentAttention({ name, credit, task }: AgentAttentionProps) {
  const rows = credit.agent_attention;
  if (!rows) return null;
  const agentName = (agent: number) => task.agent_names[agent] ?? `Agent ${agent + 1}`;
  return (
    <section className="card" aria-label={`Attention in the ${name.toLowerCase()} clip`}>
      <h2>Attention between agents, {name.toLowerCase()} clip</h2>
      <ScrollingTable label={`Matrix of the ${name.toLowerCase()} clip`}>
        <table className="attention">
          <thead>
            <tr>
              <td />
              {rows.map((_, agent) => (
                <th key={agentName(agent)} scope="col">
                  <AgentSwatch colours={task.agent_colours} agent={agent} /> {agentName(agent)}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {rows.map((row, agent) => (
              <tr key={agentName(agent)}>
                <th scope="row">
                  <AgentSwatch colours={task.agent_colours} agent={agent} /> {agentName(agent)}
                </th>
                {row.map((weight, other) => (
                  <td
                    key={agentName(other)}
                    className="number"
                    style={{
                      background: `color-mix(in srgb, var(--accent) ${(STRONGEST * weight).toFixed(1)}%, var(--surface))`,
                    }}
                  >
                    {weight.toFixed(2)}
                  </td>
                ))}
              </tr>
            ))}
          </tbody>
        </table>
      </ScrollingTable>
      <p className="muted">Each row sums to 1: on which agents its reward depends, mean over the steps.</p>
    </section>
  );
}
