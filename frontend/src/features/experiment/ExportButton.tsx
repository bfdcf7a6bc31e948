import { useEffect, useRef, useState } from "react";
import { errorMessage } from "@/shared/api/errors";
import type { operations } from "@/shared/api/schema";
import { receiveFile } from "@/shared/api/transfer";
import { download } from "@/shared/charts/download";
import { FOREIGN_FORMATS } from "@/shared/ui/foreignFormats";
import { Alert } from "@/shared/ui/Message";
import { ProgressBar } from "@/shared/ui/ProgressBar";

type Format = NonNullable<NonNullable<operations["export_experiment"]["parameters"]["query"]>["format"]>;

interface FormatText {
  title: string;
  /** what the file is, and what of the experiment is in it */
  help: string;
  extension: string;
}

const FORMATS: Record<Format, FormatText> = {
  tables: {
    title: "Parquet tables",
    help: "A ZIP file with all segments, queries and labels, which Import reads.",
    extension: "zip",
  },
  mapt: {
    title: FOREIGN_FORMATS.mapt,
    help: "A pickle of the labelled pairs.",
    extension: "pkl",
  },
  imitation: {
    title: FOREIGN_FORMATS.imitation,
    help: "A pickle of the labelled pairs, for PreferenceDataset.load.",
    extension: "pkl",
  },
  offline: {
    title: FOREIGN_FORMATS.offline,
    help: "A ZIP file with the labelled segments as a D4RL file, and the three pickles of labels.",
    extension: "zip",
  },
  minari: {
    title: FOREIGN_FORMATS.minari,
    help: "A ZIP file of a dataset with every segment as an episode, without labels.",
    extension: "zip",
  },
  d4rl: {
    title: FOREIGN_FORMATS.d4rl,
    help: "An HDF5 file with every segment as an episode, without labels.",
    extension: "hdf5",
  },
};
const FORMAT_NAMES = Object.keys(FORMATS) as Format[];

type Progress =
  | { state: "idle" | "writing" | "failed"; error?: string }
  | { state: "loading"; share: number };

/** Downloads the segments, queries and labels of an experiment in the chosen format, and shows how far it is. */
export function ExportButton({ experimentId }: { experimentId: string }) {
  const [format, setFormat] = useState<Format>("tables");
  const [progress, setProgress] = useState<Progress>({ state: "idle" });
  const running = useRef<AbortController>(null);
  useEffect(() => () => running.current?.abort(), []);
  const start = async () => {
    const abort = new AbortController();
    running.current = abort;
    setProgress({ state: "writing" });
    try {
      const file = await receiveFile(
        `/api/v1/experiments/${experimentId}/export?format=${format}`,
        (share) => setProgress({ state: "loading", share }),
        abort.signal,
      );
      download(file, `${experimentId}.${FORMATS[format].extension}`, file.type);
      setProgress({ state: "idle" });
    } catch (error) {
      setProgress(abort.signal.aborted ? { state: "idle" } : { state: "failed", error: errorMessage(error) });
    }
  };
  if (progress.state === "writing" || progress.state === "loading") {
    const share = progress.state === "loading" ? progress.share : 0;
    return (
      <div className="export-line" role="status">
        <ProgressBar
          label="Export"
          value={Math.round(100 * share)}
          max={100}
          text={progress.state === "writing" ? "the server writes the file…" : `${Math.round(100 * share)}%`}
        />
        <button type="button" className="button small" onClick={() => running.current?.abort()}>
          Cancel
        </button>
      </div>
    );
  }
  return (
    <div className="export-line">
      <div className="row">
        <label>
          Format{" "}
          <select
            className="select"
            value={format}
            aria-describedby="export-format-help"
            onChange={(event) => {
              setFormat(event.target.value as Format);
              setProgress({ state: "idle" });
            }}
          >
            {FORMAT_NAMES.map((each) => (
              <option key={each} value={each}>
                {FORMATS[each].title}
              </option>
            ))}
          </select>
        </label>
        <button type="button" className="button" onClick={() => void start()}>
          Export
        </button>
      </div>
      <p className="muted" id="export-format-help">
        {FORMATS[format].help}
      </p>
      {progress.error && <Alert>{progress.error}</Alert>}
    </div>
  );
}
