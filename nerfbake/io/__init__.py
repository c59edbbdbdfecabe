"""Read and write scenes. No other package opens files.

Files are read whole, so that a file that is truncated while it is read cannot crash the process. '-' is stdin or
stdout. An output appears completely or not at all. Any format may be compressed with zstd: outputs if they have the
extension .zst, inputs by their first bytes.
"""

from nerfbake.catalog import uncompressed as uncompressed
from nerfbake.contract import PhotographMetadata as PhotographMetadata
from nerfbake.io.checkpoints import checkpoint_path as checkpoint_path
from nerfbake.io.checkpoints import load_checkpoint as load_checkpoint
from nerfbake.io.checkpoints import remove_checkpoint as remove_checkpoint
from nerfbake.io.checkpoints import require_checkpoints as require_checkpoints
from nerfbake.io.checkpoints import save_checkpoint as save_checkpoint
from nerfbake.io.own_folders import FolderContents as FolderContents
from nerfbake.io.reading import Loaded as Loaded
from nerfbake.io.reading import Truth as Truth
from nerfbake.io.reading import check as check
from nerfbake.io.reading import decode_files as decode_files
from nerfbake.io.reading import find_photograph as find_photograph
from nerfbake.io.reading import is_folder as is_folder
from nerfbake.io.reading import load as load
from nerfbake.io.reading import load_files as load_files
from nerfbake.io.reading import load_folder as load_folder
from nerfbake.io.reading import load_lines as load_lines
from nerfbake.io.reading import load_metadata as load_metadata
from nerfbake.io.reading import load_page_content as load_page_content
from nerfbake.io.reading import load_photograph as load_photograph
from nerfbake.io.reading import load_preview as load_preview
from nerfbake.io.reading import load_split as load_split
from nerfbake.io.reading import load_thumbnail as load_thumbnail
from nerfbake.io.reading import load_with_format as load_with_format
from nerfbake.io.reading import picture_in as picture_in
from nerfbake.io.reading import unread_cameras as unread_cameras
from nerfbake.io.results import report_result as report_result
from nerfbake.io.sources import STREAM as STREAM
from nerfbake.io.sources import StoredNames as StoredNames
from nerfbake.io.sources import blame as blame
from nerfbake.io.sources import reading_name as reading_name
from nerfbake.io.streams import json_line as json_line
from nerfbake.io.streams import print_json as print_json
from nerfbake.io.streams import print_names as print_names
from nerfbake.io.streams import print_text as print_text
from nerfbake.io.streams import versioned as versioned
from nerfbake.io.targets import is_pipe_or_device as is_pipe_or_device
from nerfbake.io.targets import rejected_path as rejected_path
from nerfbake.io.targets import replacing as replacing
from nerfbake.io.targets import replacing_folder as replacing_folder
from nerfbake.io.targets import require_absent as require_absent
from nerfbake.io.targets import require_no_folder as require_no_folder
from nerfbake.io.targets import require_rejected_absent as require_rejected_absent
from nerfbake.io.targets import require_room as require_room
from nerfbake.io.videos import opened_video as opened_video
from nerfbake.io.videos import save_photograph as save_photograph
from nerfbake.io.writing import PendingFile as PendingFile
from nerfbake.io.writing import format_for as format_for
from nerfbake.io.writing import keep_partial as keep_partial
from nerfbake.io.writing import paths_beside as paths_beside
from nerfbake.io.writing import save as save
from nerfbake.io.writing import save_files as save_files
from nerfbake.io.writing import save_folder as save_folder
from nerfbake.io.writing import saving as saving
from nerfbake.io.writing import saving_folder as saving_folder
