import { useMutation, useQueryClient } from "@tanstack/react-query";
import { useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { errorMessage } from "@/shared/api/errors";
import { experimentQuery } from "@/shared/api/queries";
import type { Experiment } from "@/shared/api/types";
import { ConfirmDialog } from "@/shared/ui/ConfirmDialog";
import { Alert } from "@/shared/ui/Message";

type Action = "pause" | "resume" | "cancel";

const DIALOGS = {
  pause: {
    title: "Pause this experiment?",
    text: "The policy stops after its current update, and labellers get no new pairs until you resume it.",
    confirm: "Pause",
    button: "Pause",
  },
  resume: {
    title: "Resume this experiment?",
    text: "The policy continues from its last checkpoint, and labellers get pairs again.",
    confirm: "Resume",
    button: "Resume",
  },
  cancel: {
    title: "Cancel this experiment?",
    text: "A cancelled experiment cannot be resumed. Its labels, clips and reward versions are kept.",
    confirm: "Cancel experiment",
    button: "Cancel",
  },
} as const;

/** The buttons that pause, resume and cancel an experiment, each with a confirmation. */
export function Controls({ experiment }: { experiment: Experiment }) {
  const [dialog, setDialog] = useState<Action | null>(null);
  const cache = useQueryClient();
  const change = useMutation({
    mutationFn: (action: Action) =>
      unwrap(
        api.POST(`/api/v1/experiments/{experiment_id}/${action}`, {
          params: { path: { experiment_id: experiment.id } },
        }),
      ),
    onSuccess: (updated) => cache.setQueryData(experimentQuery(experiment.id).queryKey, updated),
  });
  const actions = actionsOf(experiment.status);
  return (
    <>
      {change.error && <Alert>{errorMessage(change.error)}</Alert>}
      {actions.map((action) => (
        <button
          key={action}
          type="button"
          className="button"
          disabled={change.isPending}
          onClick={() => setDialog(action)}
        >
          {DIALOGS[action].button}
        </button>
      ))}
      {dialog && (
        <ConfirmDialog
          title={DIALOGS[dialog].title}
          confirm={DIALOGS[dialog].confirm}
          danger={dialog === "cancel"}
          onConfirm={() => change.mutate(dialog)}
          onClose={() => setDialog(null)}
        >
          {DIALOGS[dialog].text}
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
