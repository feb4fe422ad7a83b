// Holds a pendulum where it hangs, over gRPC: go run . [HOST:PORT [STEPS]]
//
// `./generate.sh` makes the package of messages from the contract first, with protoc, protoc-gen-go and
// protoc-gen-go-grpc.
package main

import (
	"context"
	"errors"
	"fmt"
	"log"
	"os"
	"strconv"

	"google.golang.org/grpc"

	v1 "plantd-example/plantdv1"
)

func main() {
	log.SetFlags(0)
	address, steps := "127.0.0.1:50051", uint64(100)
	if len(os.Args) > 1 {
		address = os.Args[1]
	}
	if len(os.Args) > 2 {
		count, err := strconv.ParseUint(os.Args[2], 10, 64)
		check(err)
		steps = count
	}
	check(hold(address, steps))
}

func check(err error) {
	if err != nil {
		log.Fatal(err)
	}
}

func hold(address string, steps uint64) error {
	// Without TLS, by the call that every version of grpc 1 has.
	connection, err := grpc.Dial(address, grpc.WithInsecure())
	if err != nil {
		return err
	}
	defer connection.Close()
	plants, ctx := v1.NewPlantServiceClient(connection), context.Background()

	created, err := plants.CreatePlant(ctx, &v1.CreatePlantRequest{Model: "pendulum"})
	if err != nil {
		return err
	}
	id := created.GetPlant().GetId()
	defer plants.DeletePlant(ctx, &v1.DeletePlantRequest{Id: id})

	stream, err := plants.Drive(ctx)
	if err != nil {
		return err
	}
	ask := func(request *v1.DriveRequest) (*v1.DriveResponse, error) {
		if err := stream.Send(request); err != nil {
			return nil, err
		}
		answer, err := stream.Recv()
		if failure := answer.GetFailure(); failure != nil {
			return nil, errors.New(failure.GetFailure().GetMessage())
		}
		return answer, err
	}
	open := &v1.DriveOpen{Id: id}
	answer, err := ask(&v1.DriveRequest{Request: &v1.DriveRequest_Open{Open: open}})
	if err != nil {
		return err
	}
	state := answer.GetOpened().GetPlant().GetState()
	for k := uint64(1); k <= steps; k++ {
		// The conversion keeps processors from rounding product and difference only once.
		u := float64(-3*state.Q[0]) - state.P[0]
		input := &v1.DriveInput{Sequence: k, U: []float64{u}}
		answer, err := ask(&v1.DriveRequest{Request: &v1.DriveRequest_Input{Input: input}})
		if err != nil {
			return err
		}
		state = answer.GetStep().GetState()
		fmt.Println(state.Q[0], state.P[0], state.Velocity[0])
	}
	return stream.CloseSend()
}
