// otelcol is the OpenTelemetry Collector with what the tests need: it receives traces by OTLP, and writes each batch to standard output as
// one line, OTLP's protobuf in base64.
package main

import (
	"context"
	"encoding/base64"
	"fmt"
	"log"

	"go.opentelemetry.io/collector/component"
	"go.opentelemetry.io/collector/confmap"
	"go.opentelemetry.io/collector/confmap/provider/yamlprovider"
	"go.opentelemetry.io/collector/exporter"
	"go.opentelemetry.io/collector/exporter/exporterhelper"
	"go.opentelemetry.io/collector/otelcol"
	"go.opentelemetry.io/collector/pdata/ptrace"
	"go.opentelemetry.io/collector/receiver"
	"go.opentelemetry.io/collector/receiver/otlpreceiver"
	"go.opentelemetry.io/collector/service/telemetry/otelconftelemetry"
)

func main() {
	command := otelcol.NewCommand(otelcol.CollectorSettings{
		BuildInfo: component.BuildInfo{Command: "otelcol", Description: "the OpenTelemetry Collector, for tests"},
		Factories: factories,
		ConfigProviderSettings: otelcol.ConfigProviderSettings{ResolverSettings: confmap.ResolverSettings{
			ProviderFactories: []confmap.ProviderFactory{yamlprovider.NewFactory()},
			DefaultScheme:     "yaml",
		}},
	})
	if err := command.Execute(); err != nil {
		log.Fatal(err)
	}
}

func factories() (otelcol.Factories, error) {
	all := otelcol.Factories{Telemetry: otelconftelemetry.NewFactory()}
	var err error
	if all.Receivers, err = otelcol.MakeFactoryMap[receiver.Factory](otlpreceiver.NewFactory()); err != nil {
		return all, err
	}
	kind := component.MustNewType("lines")
	lines := exporter.NewFactory(kind, func() component.Config { return &struct{}{} }, exporter.WithTraces(newLines, component.StabilityLevelStable))
	all.Exporters, err = otelcol.MakeFactoryMap[exporter.Factory](lines)
	return all, err
}

func newLines(ctx context.Context, set exporter.Settings, config component.Config) (exporter.Traces, error) {
	write := func(_ context.Context, batch ptrace.Traces) error {
		bytes, err := (&ptrace.ProtoMarshaler{}).MarshalTraces(batch)
		if err != nil {
			return err
		}
		_, err = fmt.Println(base64.StdEncoding.EncodeToString(bytes))
		return err
	}
	return exporterhelper.NewTraces(ctx, set, config, write)
}
