import { useMutation, useQueryClient } from "@tanstack/react-query";
import { useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { sentenceOf } from "@/shared/api/errors";
import { experimentQuery } from "@/shared/api/queries";
import type { Experiment } from "@/shared/api/types";
import { ConfirmDialog } from "@/shared/ui/ConfirmDialog";
import { Trouble } from "@/shared/ui/Message";

type Action = "pause" | "resume" | "cancel";

const QUESTIONS = {
  pause: {
    title: "Pause this experiment?",
    text: "The policy stops after its current update and labellers get no more pairs, until it is resumed.",
    confirm: "Pause",
  },
  resume: {
    title: "Resume this experiment?",
    text: "The policy goes on from its last checkpoint, and labellers get pairs again.",
    confirm: "Resume",
  },
  cancel: {
    title: "Cancel this experiment?",
    text: "It stops for good. Its labels, clips and reward versions are kept, but it cannot be resumed.",
    confirm: "Cancel the experiment",
  },
} as const;

/** Pause, resume, cancel. */
export function Controls({ experiment }: { experiment: Experiment }) {
  const [asked, setAsked] = useState<Action | null>(null);
  const cache = useQueryClient();
  const change = useMutation({
    mutationFn: (action: Action) =>
      unwrap(
        api.POST(`/api/v1/experiments/{experiment_id}/${action}`, {
          params: { path: { experiment_id: experiment.id } },
        }),
      ),
    onSuccess: (fresh) => cache.setQueryData(experimentQuery(experiment.id).queryKey, fresh),
  });
  const actions = actionsOf(experiment.status);
  return (
    <>
      {change.error && <Trouble>{sentenceOf(change.error)}</Trouble>}
      {actions.map((action) => (
        <button
          key={action}
          type="button"
          className="button"
          disabled={change.isPending}
          onClick={() => setAsked(action)}
        >
          {QUESTIONS[action].confirm.split(" ")[0]}
        </button>
      ))}
      {asked && (
        <ConfirmDialog
          title={QUESTIONS[asked].title}
          confirm={QUESTIONS[asked].confirm}
          danger={asked === "cancel"}
          onConfirm={() => change.mutate(asked)}
          onClose={() => setAsked(null)}
        >
          {QUESTIONS[asked].text}
        </ConfirmDialog>
      )}
    </>
  );
}

function actionsOf(status: Experiment["status"]): Action[] {
  if (status === "running") return ["pause", "cancel"];
  if (status === "paused") return ["resume", "cancel"];
  if (status === "failed") return ["resume"];
  return [];
}
