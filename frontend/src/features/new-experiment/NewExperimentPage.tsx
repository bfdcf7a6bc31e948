import { useMutation, useQuery } from "@tanstack/react-query";
import { type FormEvent, useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { errorMessage } from "@/shared/api/errors";
import { tasksQuery } from "@/shared/api/queries";
import { canManageExperiments, type Me, type Task } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link, navigate } from "@/shared/routing/router";
import { Alert, Message } from "@/shared/ui/Message";
import { ChoiceField, Field, NumberField } from "./Field";
import { clipWords, DEFAULTS, type FieldName, type Form, fieldOf, requestOf } from "./fields";
import "./form.css";

/** Start an experiment. The server checks; what it refuses is said at the field it is about. */
export function NewExperimentPage({ me }: { me: Me }) {
  const tasks = useQuery(tasksQuery);
  if (!canManageExperiments(me)) {
    return (
      <Message title="Researchers start experiments">
        <p>You are signed in as a {me.role}: ask a researcher to start one.</p>
        <Link to={paths.experiments()}>All experiments</Link>
      </Message>
    );
  }
  if (tasks.error) return <Message title="The tasks cannot be listed">{errorMessage(tasks.error)}</Message>;
  return tasks.data ? <ExperimentForm tasks={tasks.data} /> : null;
}

function ExperimentForm({ tasks }: { tasks: Task[] }) {
  const [form, setForm] = useState<Form>({ ...DEFAULTS, task: tasks[0]?.name ?? "" });
  const create = useMutation({
    mutationFn: (filled: Form) => unwrap(api.POST("/api/v1/experiments", { body: requestOf(filled) })),
    onSuccess: (experiment) => navigate(paths.experiment(experiment.id)),
  });
  const task = tasks.find(({ name }) => name === form.task);
  const refusal = create.error ? errorMessage(create.error) : null;
  const refused = refusal === null ? null : fieldOf(refusal);
  const of = (name: FieldName) => ({
    name,
    value: form[name],
    trouble: refused === name ? refusal : null,
    onChange: (value: string) => setForm((old) => ({ ...old, [name]: value })),
  });
  const submit = (event: FormEvent) => {
    event.preventDefault();
    create.mutate(form);
  };
  return (
    <main className="page narrow" id="content">
      <h1>New experiment</h1>
      <form onSubmit={submit} className="form">
        <Field {...of("name")} label="Name" required hint="To find it by; no two have the same." />
        <ChoiceField
          {...of("task")}
          label="Task"
          choices={tasks.map(({ name, n_agents }) => ({
            value: name,
            words: `${name} (${n_agents} agents)`,
          }))}
        />
        <Field
          {...of("instructions")}
          label="What labellers are told"
          lines={3}
          placeholder={task?.instructions ?? ""}
          hint="Left empty, they are told what stands here in grey."
        />
        <div className="form-grid">
          <NumberField {...of("total_steps")} label="Steps to train" hint="Of all environments together." />
          <NumberField {...of("label_budget")} label="Labels in all" hint="The budget of human judgement." />
          <NumberField
            {...of("initial_labels")}
            label="Labels before the first reward model"
            hint="Before the first reward version."
          />
          <NumberField
            {...of("labels_per_version")}
            label="Labels per version"
            hint="New ones, for the next version."
          />
        </div>
        <details className="more" open={refused !== null && refused !== "instructions"}>
          <summary>More settings</summary>
          <div className="form-grid">
            <NumberField
              {...of("segment_steps")}
              label="Steps of a clip"
              hint={clipWords(form.segment_steps, task) || "At most an episode."}
            />
            <NumberField {...of("seed")} label="Seed" hint="The same seed, the same run." />
            <ChoiceField
              {...of("query_selection")}
              label="Pairs are chosen"
              choices={[
                { value: "uniform", words: "at random" },
                { value: "disagreement", words: "where reward models disagree" },
                { value: "entropy", words: "where reward models are unsure" },
                { value: "k_center", words: "unlike those before" },
                { value: "disagreement_k_center", words: "by disagreement, then spread out" },
                { value: "entropy_k_center", words: "by unsureness, then spread out" },
              ]}
            />
            <ChoiceField
              {...of("label_schedule")}
              label="Labels are asked for"
              choices={[
                { value: "power", words: "somewhat more often early on" },
                { value: "constant", words: "evenly over the run" },
                { value: "decaying", words: "much more often early on" },
              ]}
            />
            <ChoiceField
              {...of("pacing")}
              label="When labels are late"
              choices={[
                { value: "wait", words: "the policy waits for them" },
                { value: "free", words: "the policy trains on" },
              ]}
            />
            <ChoiceField
              {...of("reward_source")}
              label="The policy learns from"
              choices={[
                { value: "preferences", words: "your labels" },
                { value: "true", words: "the task’s own reward (a baseline)" },
              ]}
            />
            <ChoiceField
              {...of("reward_preset")}
              label="Reward model"
              choices={[
                { value: "small", words: "small, for a laptop" },
                { value: "paper", words: "as in the paper, for a GPU" },
              ]}
            />
            <ChoiceField
              {...of("credit")}
              label="Every agent gets"
              choices={[
                { value: "shared", words: "the mean reward" },
                { value: "individual", words: "its own reward" },
              ]}
            />
          </div>
        </details>
        {refusal && refused === null && <Alert>{refusal}</Alert>}
        <div className="row">
          <button type="submit" className="button primary" disabled={create.isPending}>
            {create.isPending ? "Starting…" : "Start"}
          </button>
          <Link to={paths.experiments()} className="button">
            Back
          </Link>
        </div>
      </form>
    </main>
  );
}
