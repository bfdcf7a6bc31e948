import { useMutation, useQuery } from "@tanstack/react-query";
import { type FormEvent, useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { errorMessage } from "@/shared/api/errors";
import { tasksQuery } from "@/shared/api/queries";
import { canManageExperiments, type Me, type Task } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link, navigate } from "@/shared/routing/router";
import { Alert, Message } from "@/shared/ui/Message";
import { Field } from "./Field";
import { FIELDS, type FieldSpec, type FormValues, fieldOfError, toRequest } from "./fields";
import "./form.css";

/** The page on which a researcher starts an experiment. */
export function NewExperimentPage({ me }: { me: Me }) {
  const tasks = useQuery(tasksQuery);
  if (!canManageExperiments(me)) {
    return (
      <Message title="Only researchers can start experiments">
        <p>You are signed in as a {me.role}. Ask a researcher to start an experiment.</p>
        <Link to={paths.experiments()}>All experiments</Link>
      </Message>
    );
  }
  if (tasks.error) return <Message title="Cannot load the tasks">{errorMessage(tasks.error)}</Message>;
  return tasks.data ? <ExperimentForm tasks={tasks.data} /> : null;
}

/** The form. The server validates all settings; its errors are shown at the field they are about. */
function ExperimentForm({ tasks }: { tasks: Task[] }) {
  const [values, setValues] = useState<FormValues>({ task: tasks[0]?.name ?? "" });
  const create = useMutation({
    mutationFn: (form: FormValues) => unwrap(api.POST("/api/v1/experiments", { body: toRequest(form) })),
    onSuccess: (experiment) => navigate(paths.experiment(experiment.id)),
  });
  const task = tasks.find(({ name }) => name === values.task);
  const message = create.error ? errorMessage(create.error) : null;
  const invalid = fieldOfError(create.error);
  const propsOf = (field: FieldSpec) => ({
    field,
    value: values[field.name] ?? "",
    error: invalid === field.name ? message : null,
    onChange: (value: string) => setValues((old) => ({ ...old, [field.name]: value })),
  });
  const submit = (event: FormEvent) => {
    event.preventDefault();
    create.mutate(values);
  };
  const { name, task: taskField, instructions, ...numbers } = FIELDS.basic;
  return (
    <main className="page narrow" id="content">
      <h1>New experiment</h1>
      <form onSubmit={submit} className="form">
        {name && <Field {...propsOf(name)} />}
        {taskField && <Field {...propsOf({ ...taskField, help: "" })} options={tasks.map(optionOf)} />}
        {instructions && (
          <Field
            {...propsOf({
              ...instructions,
              help: "Shown to labellers. Leave empty to use the default shown.",
            })}
            lines={3}
            placeholder={task?.instructions ?? ""}
          />
        )}
        <div className="form-grid">
          {Object.values(numbers).map((field) => (
            <Field key={field.name} {...propsOf(field)} />
          ))}
        </div>
        <Section title="More settings" fields={FIELDS.advanced} invalid={invalid}>
          {(field) => (
            <Field
              key={field.name}
              {...propsOf(field)}
              note={
                field.name === "segment_steps" ? clipLength(values[field.name] || field.default, task) : ""
              }
            />
          )}
        </Section>
        <Section title="Policy settings" fields={FIELDS.policy} invalid={invalid}>
          {(field) => (
            <Field key={field.name} {...propsOf(field)} placeholder={policyPlaceholder(field, values)} />
          )}
        </Section>
        {message && invalid === null && <Alert>{message}</Alert>}
        <div className="row">
          <button type="submit" className="button primary" disabled={create.isPending}>
            {create.isPending ? "Starting…" : "Start experiment"}
          </button>
          <Link to={paths.experiments()} className="button">
            Cancel
          </Link>
        </div>
      </form>
    </main>
  );
}

interface SectionProps {
  title: string;
  fields: readonly FieldSpec[];
  invalid: string | null;
  children: (field: FieldSpec) => React.ReactNode;
}

/** A collapsed group of fields. It opens when one of them is invalid. */
function Section({ title, fields, invalid, children }: SectionProps) {
  if (fields.length === 0) return null;
  return (
    <details
      className="advanced"
      open={fields.some(({ name }) => name === invalid)}
      // The browser can only report a field that is out of its range while the field is visible.
      onInvalidCapture={(event) => {
        event.currentTarget.open = true;
      }}
    >
      <summary>{title}</summary>
      <div className="form-grid">{fields.map(children)}</div>
    </details>
  );
}

function optionOf({ name, n_agents }: Task): { value: string; text: string } {
  return { value: name, text: `${name} (${n_agents} agents)` };
}

/** The default of a policy setting. The schema has those of its default algorithm; others have their own. */
function policyPlaceholder(field: FieldSpec, values: FormValues): string {
  const algorithm = values["policy.algorithm"];
  const usual = FIELDS.policy.find(({ name }) => name === "policy.algorithm")?.default;
  return !algorithm || algorithm === usual ? field.default : `default of ${algorithm}`;
}

/** The duration of a clip with this many steps; empty for an invalid number. */
function clipLength(steps: string, task: Task | undefined): string {
  const seconds = Number(steps) * (task?.step_seconds ?? Number.NaN);
  return Number.isFinite(seconds) && seconds > 0 ? `This is a clip of ${seconds.toFixed(1)} s.` : "";
}
