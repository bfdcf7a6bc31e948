import { useQuery } from "@tanstack/react-query";
import { workersQuery } from "@/shared/api/queries";
import { isDown, plural, workersTrouble } from "@/shared/ui/words";

const STATES: Readonly<Record<string, string>> = {
  starting: "starting",
  idle: "idle",
  working: "working",
  backing_off: "restarting soon",
  stopped: "stopped",
};

/** The processes that do the work, and whether they live. */
export function Workers() {
  const { data = [] } = useQuery(workersQuery);
  const trouble = workersTrouble(data);
  return (
    <section className="card" aria-labelledby="workers-title">
      <h2 id="workers-title">Workers</h2>
      {trouble && <p className="trouble">{trouble}</p>}
      {data.length === 0 && <p className="quiet">None has reported yet.</p>}
      <ul className="workers">
        {data.map((worker) => (
          <li key={worker.id} data-down={isDown(worker) || undefined}>
            <span className="worker-name">{worker.id}</span>
            <span>
              {isDown(worker) ? "⚠ " : ""}
              {STATES[worker.state] ?? worker.state}
            </span>
            <span className="quiet">
              {worker.detail}
              {worker.restarts > 0 ? ` (${plural(worker.restarts, "restart")})` : ""}
            </span>
          </li>
        ))}
      </ul>
    </section>
  );
}
