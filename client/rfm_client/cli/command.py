# SPDX-License-Identifier: MIT
"""Base of all commands: options made of settings, errors on one line, exit codes."""

from __future__ import annotations

import copy
import functools
import inspect
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, Any, NoReturn, TypeAlias, get_args, get_origin

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

from rfm_client.contract import errors
from rfm_client.contract.settings import ConfigError, Setting, Settings, Texts, placeholder_of, settings_of

STANDARD_OUTPUT = "-"

Given: TypeAlias = dict[str, Any]  # values of the given options, by setting


class ExitCode(IntEnum):
    """Exit codes of commands, for scripts."""

    OK = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 3
    DEADLINE = 4
    NO_MODEL = 5
    INTERRUPTED = 130


EXIT_CODES = (
    "Exit codes: 0 done; 1 a sample (or anything not named here) failed; 2 wrong usage; 3 server unavailable; "
    "4 out of time; 5 model not served; 130 interrupted. Errors are written to standard error, one a line."
)

_ERROR_CODES: dict[type[BaseException], ExitCode] = {
    errors.ServerUnavailableError: ExitCode.UNAVAILABLE,
    errors.DeadlineExceededError: ExitCode.DEADLINE,
    errors.ModelNotFoundError: ExitCode.NO_MODEL,
}


@dataclass(frozen=True)
class OptionsOf:
    """A mark of a command's parameter, whose settings become options.

    A ``Given`` parameter gets only the given settings, another parameter an object of ``settings``.

    prefix: before each option's name
    only: settings with an option; empty: all
    required: settings that must be given
    defaults: replace the settings' own defaults
    helps: replace the settings' own help texts
    title: replaces the settings' own heading
    reads_variables: False: the help names environment variables, and the parent command reads them
    """

    settings: type[Settings]
    prefix: str = ""
    only: Collection[str] = ()
    required: Collection[str] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict)
    helps: Mapping[str, str] = field(default_factory=dict)
    title: str | None = None
    reads_variables: bool = True

    @property
    def chosen(self) -> list[Setting]:
        """The settings with an option."""
        known = settings_of(self.settings).values()
        return [each for each in known if each.has_option and (not self.only or each.name in self.only)]

    def option(self, setting: Setting) -> str:
        """Return the option of a setting, with the prefix."""
        return f"--{self.prefix}{setting.option.removeprefix('--')}"

    def name(self, setting: Setting) -> str:
        """Return the parameter name that typer makes of an option."""
        return f"{self.prefix}{setting.name}".replace("-", "_")

    def parameter(self, setting: Setting) -> inspect.Parameter:
        """Return the parameter for typer. Its default is None, so that a file or the settings' default can decide."""
        is_required = setting.name in self.required
        default = None if is_required else self.defaults.get(setting.name, setting.default)
        option = self.option(setting)
        if default is True:
            option += f"/--{self.prefix}no-{setting.option.removeprefix('--')}"
        described = typer.Option(
            option,
            help=self._help(setting, default),
            metavar=setting.placeholder,
            envvar=setting.variable if self.reads_variables else None,
            show_default=False,
            show_envvar=False,  # ``help`` has it
            rich_help_panel=setting.group or self.title or self.settings.TITLE,
        )
        kind = str if setting.parse else list[str] if setting.kind == Texts else setting.kind
        return inspect.Parameter(
            self.name(setting),
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if is_required else None,
            annotation=Annotated[kind if is_required else kind | None, described],
        )

    def _help(self, setting: Setting, default: Any) -> str:
        """The help text with bounds, default and variable of the option."""
        shown = self.option(setting) if default is True else _shown(default)
        facts = [
            *([setting.bounds] if setting.bounds else []),
            *([f"default: {shown}"] if shown else []),
            *([f"variable: {setting.variable}"] if setting.variable else []),
        ]
        text = self.helps.get(setting.name, setting.help)
        return f"{text}  [{'; '.join(facts)}]" if facts else text

    def taken_from(self, values: dict[str, Any]) -> Given:
        """Remove this mark's options from ``values``, and return the given settings. Raises typer.BadParameter."""
        given = {}
        for each in self.chosen:
            value = values.pop(self.name(each))
            if value in (None, []):
                continue
            with usage_errors(self.option(each)):
                value = each.parse(value) if each.parse else value
            given[each.name] = tuple(value) if isinstance(value, list) else value
        return given


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with an option for each setting of its ``Settings`` and ``OptionsOf`` parameters."""
    # not typing.get_type_hints, which in Python 3.10 hides the annotation of a parameter whose default is None
    hints = {name: each.annotation for name, each in inspect.signature(command, eval_str=True).parameters.items()}
    marked = {name: mark for name, hint in hints.items() if (mark := _mark(hint)) is not None}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name in marked:
            parameters += map(marked[name].parameter, marked[name].chosen)
        else:
            kind = inspect.Parameter.KEYWORD_ONLY
            parameters.append(parameter.replace(annotation=_with_placeholder(hints[name]), kind=kind))

    @functools.wraps(command)
    def run(**values: Any) -> None:
        try:
            for name, mark in marked.items():
                given = mark.taken_from(values)
                is_given = get_args(hints[name])[:1] == (Given,)
                values[name] = given if is_given else mark.settings(**{**mark.defaults, **given})
            command(**values)
        except ConfigError as error:
            raise _named(error, marked.values()) from None

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


class Command(TyperCommand):
    """A command with a help section for each group of options, and errors on one line, without traceback.

    Its ``--json`` may stand without a value.
    """

    program = "rfm-client"
    has_codes = True  # False: every error ends the command with 1

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give ``--json`` without a value the value ``-``, which the parser cannot do."""
        completed: list[str] = []
        for index, word in enumerate(args):
            completed.append(word)
            following = args[index + 1] if index + 1 < len(args) else "--"
            if word == "--json" and following.startswith("-") and following != STANDARD_OUTPUT:
                completed.append(STANDARD_OUTPUT)
        return super().parse_args(ctx, completed)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the usage line: an argument's name, in brackets if it may be left out."""
        arguments = [each for each in self.get_params(ctx) if each.param_type_name == "argument"]
        names = [_argument(each) if each.required else f"[{_argument(each)}]" for each in arguments]
        return [*([self.options_metavar] if self.options_metavar else []), *names]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write sections for the arguments, the command's own options, and each group of settings."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                is_argument = parameter.param_type_name == "argument"
                record = (_argument(parameter), record[1]) if is_argument else record
                title = "Arguments" if is_argument else getattr(parameter, "rich_help_panel", None) or "Options"
                sections.setdefault(title, []).append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)

    def invoke(self, ctx: Any) -> Any:
        """Run the command, and report an error, each of its lines with the name of the program."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            code, lines = ExitCode.INTERRUPTED, ["interrupted"]
        except BrokenPipeError:  # the reader of the output has closed the pipe
            raise
        except ImportError as error:
            code, lines = ExitCode.FAILED, [missing_package(error)]
        except (errors.LocatedError, errors.RewardError, OSError) as error:
            code = exit_code(error) if self.has_codes else ExitCode.FAILED
            lines = str(error).split("\n")
        for line in lines:
            report(line, self.program)
        raise typer.Exit(code)


def exit_code(error: BaseException) -> ExitCode:
    """Return the exit code of a command that fails with this error."""
    return next((code for kind, code in _ERROR_CODES.items() if isinstance(error, kind)), ExitCode.FAILED)


def exit_code_of(failures: Sequence[Exception], *, some_succeeded: bool) -> ExitCode:
    """Return the exit code after failures of samples: a special code only if all samples failed for one reason."""
    codes = {exit_code(error) for error in failures}
    if not codes:
        return ExitCode.OK
    return codes.pop() if len(codes) == 1 and not some_succeeded else ExitCode.FAILED


def report(message: str, program: str = "rfm-client") -> None:
    """Write the message as one line to standard error."""
    print(f"{program}: {' '.join(message.split())}", file=sys.stderr, flush=True)  # Rich moves it above a progress bar


def fail(message: str, program: str = "rfm-client") -> NoReturn:
    """Report the message, and end the command with 1."""
    report(message, program)
    raise typer.Exit(ExitCode.FAILED)


@contextmanager
def usage_errors(option: str) -> Iterator[None]:
    """Turn a ValueError into wrong usage of ``option``."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(getattr(error, "problem", error)), param_hint=f"'{option}'") from error


def missing_package(error: ImportError) -> str:
    """Return the error's message with the command that installs the package."""
    if "pip install" in str(error):
        return str(error)
    return f'{error}: pip install "./client[cli]"'


def _named(error: ConfigError, marks: Iterable[OptionsOf]) -> Exception:
    """Wrong usage of the options whose settings the error names; the error itself for other settings."""
    options = {each.name: mark.option(each) for mark in marks for each in mark.chosen}
    if not {error.where, error.other or error.where} <= options.keys():
        return error
    named = error.named(options.__getitem__)
    if error.other:
        return typer.BadParameter(str(named))
    return typer.BadParameter(named.problem, param_hint=f"'{named.where}'")


def _mark(hint: Any) -> OptionsOf | None:
    if isinstance(hint, type) and issubclass(hint, Settings):
        return OptionsOf(hint)
    return next((mark for mark in get_args(hint)[1:] if isinstance(mark, OptionsOf)), None)


def _with_placeholder(hint: Any) -> Any:
    """The type of a parameter; its option gets a placeholder, unless it has one."""
    kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    marks = [copy.copy(mark) for mark in marks]
    for mark in marks:
        if isinstance(mark, OptionInfo) and mark.metavar is None:
            mark.metavar = placeholder_of(kind)
    return Annotated[(kind, *marks)] if marks else hint


def _argument(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _shown(default: Any) -> str:
    """A default as one would type it; empty for none."""
    if default is None or default is False:
        return ""
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return f"{default:g}" if isinstance(default, float) else str(default)


def add_missing(app: typer.Typer, name: str, reason: str, package: str, program: str = "rfm-client") -> None:
    """Add a command that says how to install the application that has it."""

    @app.command(
        name,
        help=f"Needs rfm-{package}, which is not installed.",
        context_settings={"ignore_unknown_options": True, "allow_extra_args": True},
    )
    def missing() -> None:
        fail(f"{name}: {reason}: pip install ./client ./apps/{package}", program)
